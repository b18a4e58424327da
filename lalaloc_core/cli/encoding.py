"""`lalaloc encode` and `lalaloc features`: features of photographs, and what they show of a room."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lalaloc_core.cli.cameras import add_camera_options, stated_camera
from lalaloc_core.cli.options import BUNDLE, TURN, add_options, check_sources
from lalaloc_core.cli.plan_files import check_free, check_picture_name, write_file, write_picture
from lalaloc_core.cli.printing import print_json, print_warnings
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.shown_text import printable

if TYPE_CHECKING:
    from lalaloc_core.bundle import Manifest
    from lalaloc_core.localise.encode.features import FeatureEncoder
    from lalaloc_core.photograph import StatedCamera

_ENCODE_OPTIONS = f"""
photographs PHOTO: photographs, as for `lalaloc localise`
{TURN}
-o, --out FILE: file of the features of a single photograph (default: beside each photograph, with the suffix
    .features); of --turn: folder of the features and of turn.json, the fields to send with them (default: FILM with
    the suffix .features)
{BUNDLE}
"""
_FEATURES_OPTIONS = f"""
file FILE: a file that `lalaloc encode` wrote
--out PICTURE: drawing of the room as the features tell it, .png or .svg
--camera-height M: metres above the floor, which give lengths their scale (default: %(default)s)
{BUNDLE}
"""


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    encode = commands.add_parser("encode", help="compute the features of photographs, to send instead of them")
    add_options(encode, _ENCODE_OPTIONS, photographs={"nargs": "*"})
    add_camera_options(encode)
    encode.set_defaults(run=_encode)
    features = commands.add_parser("features", help="show what features reveal of a room")
    add_options(features, _FEATURES_OPTIONS, camera_height={"default": 1.5})
    features.set_defaults(run=_features)


def _encode(arguments: argparse.Namespace) -> None:
    from lalaloc_core.api import named, photograph_content
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.localise.encode.features import FeatureEncoder
    from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
    from lalaloc_core.photograph import open_photograph

    check_sources(arguments)
    if arguments.out is not None and len(arguments.photographs) > 1:
        raise InvalidInputError(f"--out is one file, and there are {len(arguments.photographs)} photographs")
    written = [path.with_suffix(".features") for path in arguments.photographs]
    check_free(written, arguments.photographs)
    if len({*written}) < len(written):
        double = max(written, key=written.count)
        raise InvalidInputError(f"'{double}' would be written twice; encode the photographs one by one, with --out")
    stated, bundle = stated_camera(arguments), Bundle.open(arguments.bundle)
    manifest, encoder = bundle.manifest, FeatureEncoder(bundle)
    if arguments.turn is not None:
        _encode_turn(arguments, bundle.manifest, encoder, stated)
        return
    for path in arguments.photographs:
        content = photograph_content(path)
        with named(path):
            view = open_photograph(
                content, sphere_size=sphere_size(manifest), stated=stated, patch_size=patch_size(manifest)
            )
            features = encoder.features(view)
        _write(arguments.out or path.with_suffix(".features"), features)


def _encode_turn(
    arguments: argparse.Namespace, manifest: Manifest, encoder: FeatureEncoder, stated: StatedCamera
) -> None:
    """Write the features of a turn, and the angles between them, which features cannot tell."""
    from lalaloc_core.api import read_turn
    from lalaloc_core.localise.answers.turns import overlap_warnings
    from lalaloc_core.photograph.turned import stated_headings

    photographs, angles, film = read_turn(arguments.turn, manifest, stated)
    if film is None:
        warnings = overlap_warnings(angles, min(photograph.hfov.value for photograph in photographs))
    else:
        warnings = film.warnings
    texts = [*warnings, *(text for photograph in photographs for text in photograph.warnings)]
    print_warnings((str(arguments.turn), text) for text in texts)
    out = arguments.out or arguments.turn.with_suffix(".features")
    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"'{out}' cannot be made: {error.strerror}") from error
    for index, photograph in enumerate(photographs):
        _write(out / f"{index:02}.features", encoder.features(photograph))
    headings_deg, std_deg = stated_headings(angles)
    fields = {"motion": "turn", "relative_heading_deg": headings_deg, "relative_heading_std_deg": std_deg}
    _write(out / "turn.json", json.dumps(fields, indent=1).encode())


def _write(out: Path, content: bytes) -> None:
    write_file(out, content)
    print(printable(f"{out}: {len(content)} bytes"))


def _features(arguments: argparse.Namespace) -> None:
    from lalaloc_core.api import named, photograph_content
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.draw.plan_overlays import draw_seen_room, seen_room
    from lalaloc_core.localise.encode.features import read_features
    from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
    from lalaloc_core.localise.query import CameraHeight

    if arguments.out is not None:
        check_picture_name(arguments.out)
    bundle, content = Bundle.open(arguments.bundle), photograph_content(arguments.file)
    with named(arguments.file):
        view = read_features(content, bundle)
    query = PhotographEncoder(bundle, threads=1).query(view, None, CameraHeight(arguments.camera_height))
    room = seen_room(query)
    print_json({"projection": view.projection, **room.document()})
    if arguments.out is not None:
        write_picture(draw_seen_room(room), arguments.out)
