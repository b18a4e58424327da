"""Bounds by which the rooms of a drawing are recognised, in one place, so that each can be measured by itself."""

from __future__ import annotations

from dataclasses import dataclass, field

# A range: the smallest and the largest value.
Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class WallConfig:
    """Dimensions of walls and openings (m)."""

    # Largest thickness of a wall; thicker areas are rooms. Smallest thickness; shorter ends are rounded corners.
    thickest: float = 0.55
    thinnest: float = 0.03
    # Largest width of a pier whose side is the jamb of glass; none if it is no thicker than a wall.
    widest_pier: float = 0.0
    # Widths of an opening; wider gaps stay open and join the rooms beside them.
    widest_gap: float = 1.9
    narrowest_gap: float = 0.3
    # Smallest length of a wall that forms a jamb alone; shorter walls need a jamb that faces them.
    nib: float = 0.28
    # Ends of lines nearer than this to another line are joined to it.
    snap: float = 0.06
    # Smallest area and depth of a room; smaller areas are ducts, and shallower ones are inside walls.
    smallest_room_m2: float = 0.6
    shallowest_room: float = 0.55
    # Largest depth of corners that pixels cut off the ends of walls.
    blunt: float = 0.0


@dataclass(frozen=True, kw_only=True)
class RoomBounds:
    """Bounds of `drawing/rooms_in_drawing.py`, which decide what a room is and which reading of a drawing wins."""

    walls: WallConfig = field(default_factory=WallConfig)
    # Largest distance between parts of one symbol: leaf, frame, panes.
    symbol_m: float = 0.12
    # Doors in gaps: largest distance of a hinge from an end of its gap; width of a leaf, and largest distance of its
    # tip from the other end, as shares of the gap. A leaf that is open by 90° has a distance of 1.41.
    hinge_m: float = 0.4
    leaf_of_gap: Range = (0.7, 1.35)
    open_leaf: float = 1.45
    # Overlap of a painted opening with its wall.
    seam_m: float = 0.005
    # Width of pens that draw walls.
    thick_m: Range = (0.05, 0.6)
    # Size, and width of strokes, of letters that are drawn as areas.
    letter_m: float = 0.5
    letter_stroke_m: float = 0.06
    # Largest pillar or chimney that is dark, and that is an outline; share of a wall's area that may be thicker.
    pillar_m: float = 1.3
    outlined_pillar_m: float = 0.8
    thicker: float = 0.5
    # A room that a layer names by its use may lie in other rooms by this share, and is at least this large.
    shared: float = 0.1
    smallest_room_m2: float = 0.6
    # Explanation that a door in a gap adds; a room with a name counts more.
    door: float = 0.5
    named: float = 1.25
    # A later reading wins if it explains so much more and covers so much more, or explains more still.
    better: float = 1.3
    larger: float = 1.15
    much_better: float = 1.8
    not_smaller: float = 0.85
    # Rooms that the file marks are given up for a multiple of that.
    trust_in_marks: float = 1.5
    # Share of the box around the drawing from which marked rooms are complete.
    complete: float = 0.25


ROOM_BOUNDS = RoomBounds()
