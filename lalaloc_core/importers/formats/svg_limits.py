"""Limits on the work that an SVG asks of the library that reads it, checked before it does.

`<use>` copies elements, and elements inside others. The library reads every copy with its styles, its classes, and the
transforms of all elements around it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.bounded_files import local_name
from lalaloc_core.importers.common.import_limits import Budget

HREF = "{http://www.w3.org/1999/xlink}href"
_BYTES_PER_ENTITY, _BYTES_PER_SHAPE = 12, 20
# Characters of styles, and multiples of them that a class, a transform and a path take: a second for 30 million.
_CLASS, _TRANSFORM, _PATH = 6, 12, 100
_MAX_CHARACTERS, _PER_BYTE = 30_000_000, 120
_LINE_COMMENT = re.compile(r"//.*$", re.MULTILINE)


@dataclass(frozen=True)
class _Work:
    """Copies of elements, entities, and characters of attributes and styles that are read for them."""

    copies: int = 0
    entities: int = 0
    characters: int = 0

    def __add__(self, more: _Work) -> _Work:
        return _Work(self.copies + more.copies, self.entities + more.entities, self.characters + more.characters)


def check_work(root: Element, budget: Budget) -> None:
    """Count the elements after `<use>` is expanded, which can multiply to billions, and the text read for them.

    References are resolved as svgelements does: the last element with an id, and any character before it.
    """
    by_id = {element.get("id"): element for element in root.iter() if "id" in element.attrib}
    styles = _style_sizes(root, _MAX_CHARACTERS + _PER_BYTE * budget.size_bytes)
    known: dict[Element, _Work] = {}
    open_elements: set[Element] = set()

    def work(element: Element) -> _Work:
        if element in known:
            return known[element]
        if element in open_elements:
            raise InvalidFloorPlanError("a <use> element refers to itself; remove it or convert it to paths")
        if len(open_elements) >= budget.limits.max_depth:
            raise InvalidFloorPlanError(
                f"elements and those that <use> refers to are nested more than {budget.limits.max_depth} deep "
                "(max_depth); convert <use> to paths"
            )
        open_elements.add(element)
        path = len(element.get("d", "")) + len(element.get("points", ""))
        total = _Work(1, 1 + path // _BYTES_PER_ENTITY, _PATH * path)
        for child in element:
            total += work(child)
        if local_name(element) == "use":
            target = by_id.get(element.get("href", element.get(HREF, "#"))[1:])
            total += work(target) if target is not None else _Work()
        # A transform is read again for every element inside.
        characters = _TRANSFORM * len(element.get("transform", "")) * total.copies + len(element.attrib) * total.copies
        total += _Work(characters=characters + _own_characters(element, styles))
        open_elements.discard(element)
        known[element] = total
        return total

    whole = work(root)
    budget.spend(whole.entities)
    budget.check_copies(whole.copies, _BYTES_PER_SHAPE)
    limit = _MAX_CHARACTERS + _PER_BYTE * budget.size_bytes
    if whole.characters > limit:
        raise InvalidFloorPlanError(
            f"the styles, classes, transforms and paths of the SVG's {whole.copies} elements, with copies, have "
            f"{whole.characters} characters (transforms count {_TRANSFORM} times, paths {_PATH} times); the limit is "
            f"{limit} for its size; save it as plain SVG, with few styles, transforms and copies"
        )


def _own_characters(element: Element, styles: Mapping[str, int]) -> int:
    """Return the characters of styles that are read for an element; a class takes several times its own."""
    name, classes = local_name(element), element.get("class", "")
    words = Counter(classes.split(" ")) if classes else {}
    matching = styles.get("*", 0) + styles.get(name, 0) + styles.get(f"#{element.get('id')}", 0)
    for word, times in words.items():
        matching += times * (styles.get(f".{word}", 0) + styles.get(f"{name}.{word}", 0))
    return matching + len(element.get("style", "")) + _CLASS * len(classes)


def _style_sizes(root: Element, limit: int) -> dict[str, int]:
    """Return the characters of declarations by selector, and leave only complete rules in the elements.

    The library looks for rules and comments again from every character of those that do not end.
    """
    sizes: dict[str, int] = {}
    written = 0
    for element in root.iter():
        if local_name(element) != "style":
            continue
        rules = list(_rules(element.text or ""))
        element.text = "".join(f"{selectors}{{{declarations}}}" for selectors, declarations in rules)
        for selectors, declarations in rules:
            for selector in selectors.split(","):
                name = selector.strip()
                sizes[name] = sizes.get(name, 0) + len(declarations) + 1
                written += sizes[name]
            if written > limit:
                raise InvalidFloorPlanError(
                    f"the style rules of the SVG repeat declarations of more than {limit} characters, the limit for "
                    "its size; save it as plain SVG, with styles as attributes"
                )
    return sizes


def _rules(text: str) -> Iterator[tuple[str, str]]:
    """Yield the selectors and declarations of a style sheet without comments."""
    pieces = text.split("/*")
    # A comment that does not end hides the rest.
    text = pieces[0] + "".join(piece.partition("*/")[2] for piece in pieces[1:])
    for rule in _LINE_COMMENT.sub("", text).split("}"):
        selectors, _, declarations = rule.partition("{")
        if selectors.strip() and declarations.strip():
            yield selectors.strip(), declarations.strip()
