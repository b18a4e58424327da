"""Films of a phone that is turned by hand in generated homes, and the confidence of turns that is fitted on them."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.bundle import Bundle, Manifest, default_bundle
from lalaloc_core.cli import main
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.calibrate.calibration import CalibrationConfig
from lalaloc_core.evaluate.calibrate.turn_confidence import calibrate_turns
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, split_renderer_cache
from lalaloc_core.learn.data.synthetic.turned import (
    FILM_S,
    Instant,
    Phone,
    encode_film,
    exposed,
    film_of_turn,
    turn_by_hand,
)
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.photograph import StatedCamera
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.photograph.film import read_film
from tests.core.shipped import bundle
from tests.core.taken import jpeg, sphere, take
from tests.strategies import present

PHONE = Phone(width=180, height=240)


def test_hand_turns_once_around_with_uneven_speed() -> None:
    instants = turn_by_hand(np.random.default_rng(3))
    turns = np.array([instant.turn for instant in instants])
    assert turns[0] == 0.0
    assert turns[-1] == pytest.approx(TWO_PI, abs=math.radians(3.0))
    assert instants[-1].time_s == pytest.approx(FILM_S)
    speeds = np.diff(turns) / np.diff([instant.time_s for instant in instants])
    assert 0.05 < float(speeds.std() / speeds.mean()) < 0.8
    assert float(np.std([instant.gain for instant in instants])) > 0.05
    assert instants == turn_by_hand(np.random.default_rng(3))


def test_film_cut_from_a_sphere_has_the_drawn_angles() -> None:
    room, phone = sphere("living_room"), Phone(width=270, height=360)
    instants = turn_by_hand(np.random.default_rng(0))[:24]
    frames = (exposed(room, phone.camera, instant, azimuth=instant.turn) for instant in instants)
    film = read_film(encode_film(frames), stated=StatedCamera(hfov_deg=phone.hfov_deg))
    assert film.frames == 24
    times_s, turns = [instant.time_s for instant in instants], [instant.turn for instant in instants]
    missed = wrap_angle(np.array([angle.heading for angle in film.angles]) - np.interp(film.times_s, times_s, turns))
    assert np.degrees(np.abs(missed - np.median(missed))).max() < 2.0


def test_rolling_shutter_skews_and_exposure_brightens() -> None:
    room = np.zeros((512, 1024, 3), np.uint8)
    room[:, 505:519] = 100
    still = Instant(0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    quick = still._replace(rate=math.radians(90.0), gain=1.5)

    def bar(instant: Instant) -> np.ndarray:
        picture = exposed(room, PHONE.camera, instant, azimuth=0.0)[..., 0].astype(float)
        assert picture.max() == pytest.approx(100.0 * instant.gain, abs=60.0)
        return (picture * np.arange(picture.shape[1])).sum(axis=1) / picture.sum(axis=1)

    assert bar(still)[-1] == pytest.approx(bar(still)[0], abs=0.5)
    # The camera turns to the right, so what stands moves to the left from the first row to the last.
    assert bar(quick)[-1] < bar(quick)[0] - 2.0


def test_film_of_a_home_looks_along_its_headings() -> None:
    split = SPLIT_NUMBERS["validation"]
    home, rng = home_of(split, 0, 1)
    (shot,) = sample_shots(home, 1, rng, "full")
    still = Instant(0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    renderers = split_renderer_cache(split, 0, None)
    ahead, beside, around = film_of_turn(
        shot, renderers, PHONE, [still, still._replace(turn=math.radians(90.0)), still._replace(turn=TWO_PI)]
    )
    assert ahead.shape == (240, 180, 3)
    assert np.array_equal(ahead, around)
    assert float(np.abs(ahead.astype(float) - beside).mean()) > 5.0


def test_bundle_without_confidence_of_turns_has_that_of_views(manifest: Manifest) -> None:
    view = present(manifest.view)
    own = present(manifest.confidence)
    assert replace(manifest, view=replace(view, turn_confidence=None)).confidence_for(view=True, turn=True) is (
        view.confidence
    )
    fitted = replace(manifest, view=replace(view, turn_confidence=own))
    assert fitted.confidence_for(view=True, turn=True) is own
    assert fitted.confidence_for(view=True) is view.confidence
    assert fitted.confidence_for(view=False, turn=True) is manifest.confidence
    old = json.loads(manifest.to_json())
    del old["view"]["turn_confidence"]
    assert present(Manifest.from_json(json.dumps(old)).view).turn_confidence is None


@pytest.mark.slow
def test_calibration_of_turns_changes_their_confidence_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "model"
    shutil.copytree(default_bundle(), folder)
    before = Bundle.open(folder)
    assert main(["lab", "calibrate", "--bundle", str(folder), "--turns", "--homes", "2"]) == 0
    assert "turn_validation_heading_searched_confidence" in json.loads(capsys.readouterr().out)
    after = Bundle.open(folder)
    assert after.sha256 == before.sha256
    view = present(after.manifest.view)
    model = present(view.turn_confidence)
    assert set(model.searched_heading) == set(model.known_heading) == {"retrieval", "lpo"}
    assert asdict(replace(view, turn_confidence=None)) == asdict(
        replace(present(before.manifest.view), turn_confidence=None)
    )
    spheres = replace(after.manifest, view=None)
    shutil.rmtree(folder)
    shutil.copytree(default_bundle(), folder)
    (folder / "manifest.json").write_text(spheres.to_json())
    with pytest.raises(InvalidInputError, match="has no encoder of views; leave out --turns"):
        calibrate_turns(folder, CalibrationConfig(homes=1))


def test_turn_is_told_from_a_single_view() -> None:
    model, camera = LocalModel(bundle()), Perspective.of_hfov(270, 360, math.radians(53.0))
    room, stated = sphere("kitchen"), StatedCamera(projection="perspective", hfov_deg=53.0)
    first, second = (model.open(jpeg(take(room, camera, heading_deg=angle)), stated) for angle in (0.0, 40.0))
    assert not model.encoder.query(first, None, CameraHeight(1.5)).is_turn
    turn = model.encoder.query(first, 0.5, CameraHeight(1.5), others=[(second, math.radians(40.0))])
    assert turn.is_turn
    assert present(turn.searched).value.is_turn
