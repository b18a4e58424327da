"""Write the fonts for East Asian names, subsets of Droid Sans Fallback.

`python -m scripts.make_fallback_font DroidSansFallbackFull.ttf DroidSansFallback.ttf` (Debian: fonts-droid-fallback).
The first has the characters of the Chinese and Japanese standards GB 2312, Big5 and JIS X 0208; the second, which alone
has Korean syllables, gives those of KS X 1001.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fontTools import subset

FOLDER = Path(__file__).parents[1] / "lalaloc_core/draw/fonts"
FONT, KOREAN_FONT = FOLDER / "DroidSansFallback-subset.ttf", FOLDER / "DroidSansFallback-korean.ttf"
_CODECS, _KOREAN_CODEC = ("gb2312", "big5", "shift_jis"), "euc_kr"


def characters(codec: str) -> set[int]:
    """Return the characters that a codec has in two bytes."""
    pairs = (bytes([first, second]) for first in range(0x81, 0xFF) for second in range(0x40, 0xFF))
    return {ord(character) for pair in pairs for character in pair.decode(codec, "ignore")}


def syllables() -> set[int]:
    """Return the Korean syllables of KS X 1001."""
    return {code for code in characters(_KOREAN_CODEC) if 0xAC00 <= code <= 0xD7A3}


def write_subset(source: str, codes: set[int], target: Path) -> None:
    """Write the characters of a font with some codes."""
    options = subset.Options(layout_features=[], hinting=False)
    options.drop_tables += ["GSUB", "GPOS", "GDEF", "vhea", "vmtx"]
    font = subset.load_font(source, options)
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=codes)
    subsetter.subset(font)
    if target == KOREAN_FONT:
        # Renderers take fonts of one name for one font.
        for record in font["name"].names:
            name = record.toUnicode().replace("Droid Sans Fallback", "Droid Sans Korean")
            record.string = name.encode(record.getEncoding())
    subset.save_font(font, str(target), options)


def main() -> None:
    full, korean = sys.argv[1:]
    write_subset(full, set.union(*map(characters, _CODECS)), FONT)
    write_subset(korean, syllables(), KOREAN_FONT)


if __name__ == "__main__":
    main()
