"""Names of files and rooms, and probabilities, in what people open: documents, tables and terminals."""

from __future__ import annotations

import re

# Begin of a formula in a spreadsheet, also in other widths, and behind what separates columns in some languages.
_FORMULA = re.compile(r"(^|[;\t])(?=[\s\ufeff\u200b]*[-=+@＝＋－＠﹦﹢﹣﹫])|^(?=[\t\r])")
# Control characters, bytes that were no UTF-8, and characters that are none.
_NO_TEXT = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff\ufdd0-\ufdef\ufffe\uffff]")


def printable(name: str) -> str:
    """Return a name with U+FFFD for what no document has: control characters, and bytes that are no UTF-8."""
    return _NO_TEXT.sub("\ufffd", name)


def no_formula(text: str) -> str:
    """Return text that a spreadsheet does not take for a formula."""
    return _FORMULA.sub(r"\1'", text)


def probability_text(probability: float, decimals: int = 1) -> str:
    """Return a probability in percent; from 99.5 % on "> 99 %", as no estimate is that sure."""
    return "> 99 %" if probability >= 0.995 else f"{100.0 * probability:.{decimals}f} %"
