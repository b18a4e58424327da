"""Write the font for East Asian names, a subset of Droid Sans Fallback.

`python -m scripts.make_fallback_font DroidSansFallbackFull.ttf` (Debian: fonts-droid-fallback). It keeps the characters
of the Chinese and Japanese standards GB 2312, Big5 and JIS X 0208; it has no Korean syllables.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fontTools import subset

FONT = Path(__file__).parents[1] / "lalaloc_core/draw/fonts/DroidSansFallback-subset.ttf"
_CODECS = ("gb2312", "big5", "shift_jis")


def characters(codec: str) -> set[int]:
    """Return the characters that a codec has in two bytes."""
    pairs = (bytes([first, second]) for first in range(0x81, 0xFF) for second in range(0x40, 0xFF))
    return {ord(character) for pair in pairs for character in pair.decode(codec, "ignore")}


def main() -> None:
    """Read the whole font and write the subset."""
    options = subset.Options(layout_features=[], hinting=False)
    options.drop_tables += ["GSUB", "GPOS", "GDEF", "vhea", "vmtx"]
    font = subset.load_font(sys.argv[1], options)
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=set.union(*map(characters, _CODECS)))
    subsetter.subset(font)
    subset.save_font(font, str(FONT), options)


if __name__ == "__main__":
    main()
