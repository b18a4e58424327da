"""Options of queries, films and sequences, as typed dictionaries."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Literal, ParamSpec, TypeAlias, TypedDict, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
Projection = Literal["auto", "equirectangular", "perspective", "cylindrical", "fisheye"]
Refine = Literal["none", "vdr", "lpo"]
SequenceRefine = Literal["none", "lpo"]


class ViewOptions(TypedDict, total=False):
    """Options about the camera; an option that is left out or None has the default, from the photograph's metadata.

    Attributes:
        projection: `perspective` for ordinary cameras, `equirectangular` for 360° cameras, `cylindrical` for strips of
            a phone's panorama mode, `fisheye`. Default: `auto`.
        hfov_deg: horizontal field of view of the upright photograph.
        intrinsics: camera matrix and distortion by OpenCV instead, such as {"fx": 2870, "fy": 2868, "k1": -0.03}: "fx",
            "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2"; "k4" for `fisheye`, without "p1" and "p2".
        pitch_deg: elevation of the photograph's centre above the horizon. Default: estimated.
        roll_deg: clockwise rotation of the camera about its optical axis. Default: estimated.
    """

    projection: Projection | None
    hfov_deg: float | None
    intrinsics: Mapping[str, float] | None
    pitch_deg: float | None
    roll_deg: float | None


class QueryOptions(ViewOptions, total=False):
    """Options of a query; an option that is left out or None has the default. See `ViewOptions` as well.

    Attributes:
        heading_deg: azimuth of the photograph's centre, clockwise from the plan's +y. Default: search for it.
        heading_tolerance_deg: maximum error of `heading_deg`, up to 45. Default: 0.
        camera_height_m: camera height over the floor. Default: that of the plan; unknown if the plan has none.
        camera_height_std_m: standard deviation of the camera height, which is then estimated; 0 means exact. Default:
            that of the plan, or 0.1.
        near: approximate camera position, as {"x_m": 3.5, "y_m": 2.0} in the plan, or as {"latitude": 48.1372,
            "longitude": 11.5757} if the plan has an anchor.
        radius_m: maximum distance from `near`, which requires it.
        rooms: ids or names of the rooms in which the camera may have stood.
        strict: search only the places and headings that the options allow. Default: treat them as hints, which may be
            wrong.
        refine: last stage to run: `none`, `vdr` or `lpo`. Default: the last one that the service has.
        top_k: number of candidates. Default: set by the service.
    """

    heading_deg: float | None
    heading_tolerance_deg: float | None
    camera_height_m: float | None
    camera_height_std_m: float | None
    near: Mapping[str, float] | None
    radius_m: float | None
    rooms: Sequence[str] | None
    strict: bool | None
    refine: Refine | None
    top_k: int | None


class FilmOptions(ViewOptions, total=False):
    """Options of a film; an option that is left out or None has the default. See `ViewOptions` as well.

    Attributes:
        camera_height_m, camera_height_std_m: as in `QueryOptions`, common to all photographs.
        refine: last stage to run: `none` or `lpo`. Default: the last one that the service has.
        top_k: number of candidates per photograph or frame. Default: set by the service.
    """

    camera_height_m: float | None
    camera_height_std_m: float | None
    refine: SequenceRefine | None
    top_k: int | None


class SequenceOptions(FilmOptions, total=False):
    """Options of several photographs from one spot. See `FilmOptions` as well.

    Attributes:
        motion: `turn`, as the photographs are from one spot. Photographs of a walk go to a session or an album.
        relative_heading_deg: headings relative to each other, clockwise, None where unknown. Default: from
            what the photographs show twice; turn by at most half the field of view between them.
        relative_heading_std_deg: their standard deviation. Default: 2.
        headings_deg: heading of each photograph, None where unknown.
        heading_tolerance_deg: maximum error of the headings. Default: 0.
    """

    motion: Literal["turn"]
    relative_heading_deg: Sequence[float | None] | None
    relative_heading_std_deg: float | None
    headings_deg: Sequence[float | None] | None
    heading_tolerance_deg: float | None


Options: TypeAlias = QueryOptions | SequenceOptions | FilmOptions | ViewOptions


def earlier_name(earlier: str, name: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator of methods that accept an argument under its name in versions before 0.12, too."""

    def decorate(method: Callable[P, T]) -> Callable[P, T]:
        @wraps(method)
        def call(*arguments: P.args, **named: P.kwargs) -> T:
            if earlier in named:
                warnings.warn(f"argument '{earlier}' is now '{name}'", DeprecationWarning, stacklevel=2)
                named[name] = named.pop(earlier)
            return method(*arguments, **named)

        return call

    return decorate
