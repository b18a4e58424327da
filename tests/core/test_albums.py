"""Albums: entries of photographs, corrections, and the solve for all, with the shipped model."""

import math
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from lalaloc_core.bundle import AlbumWeights
from lalaloc_core.errors import InvalidCorrectionError, InvalidEntryError, InvalidFeaturesError, InvalidInputError
from lalaloc_core.evaluate.runs.albums import pin_figures
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.entry import (
    MAX_ENTRY_BYTES,
    AlbumPhotograph,
    Correction,
    photograph_entry,
    read_correction,
    read_entry,
)
from lalaloc_core.localise.album.evidence import AlbumMemory, shared_cameras
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.pins import Album, Pin, PinPose, RoomShare, moved_pins
from lalaloc_core.localise.album.room_assignment import PARTNERS, RoomEvidence, assign_rooms
from lalaloc_core.localise.album.solve import MAX_ROOMS, calibrated, misread_share, solve_album
from lalaloc_core.localise.album.solve import _pin as _pin_of
from lalaloc_core.localise.album.states import States, by_compass, turned_together
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import patch_size, sphere_size
from lalaloc_core.photograph import Assumed, open_photograph
from lalaloc_core.photograph.exif import Taken
from tests.core.shipped import bundle, encoder
from tests.core.taken import EXAMPLES
from tests.strategies import present

NAMES = ("kitchen.jpg", "study.jpg", "bedroom.jpg", "living_room.jpg", "phone.jpg")
ROOMS = ("kitchen", "study", "bedroom", "living-room", "living-room")


@pytest.fixture(scope="module")
def ground() -> AlbumGround:
    plan = FloorPlan.from_json((EXAMPLES / "flat.json").read_text())
    grid = build_grid(plan, encoder().layouts, step_m=0.5, camera_height_m=plan.camera_height_m, latents=False)
    return AlbumGround.of_plan("flat", plan, grid)


@pytest.fixture(scope="module")
def photographs() -> list[AlbumPhotograph]:
    manifest, found = encoder().manifest, []
    for number, name in enumerate(NAMES):
        content = (EXAMPLES / name).read_bytes()
        view = open_photograph(
            content, sphere_size=sphere_size(manifest), patch_size=patch_size(manifest), purpose="album"
        )
        taken = Taken(at=datetime(2026, 5, 1, 12, number), make="M", model="P", width=1280, height=960)
        found.append(photograph_entry(name, encoder().with_features(view), taken))
    return found


@pytest.fixture(scope="module")
def solved(ground: AlbumGround, photographs: list[AlbumPhotograph]) -> tuple[Album, AlbumMemory, list[int]]:
    """Return the solved album, its memory, and the steps of its progress."""
    memory, seen = AlbumMemory(), list[int]()
    return solve_album(ground, encoder(), photographs, memory=memory, progress=seen.append), memory, seen


def test_entry_is_small_and_read_as_it_was(photographs: list[AlbumPhotograph]) -> None:
    for photograph in photographs:
        content = photograph.to_bytes(bundle())
        read = read_entry(content, bundle())
        assert len(content) <= MAX_ENTRY_BYTES
        assert (read.id, read.taken) == (photograph.id, photograph.taken)
        np.testing.assert_array_equal(read.colours, photograph.colours)
        np.testing.assert_array_equal(read.descriptors.bits, photograph.descriptors.bits)
        again, first = (present(row.photograph.features).outputs["log_profile"] for row in (read, photograph))
        np.testing.assert_allclose(again, first, rtol=1e-6)
    strip = replace(photographs[-1], taken=Taken(width=100_000, height=400))
    assert read_entry(strip.to_bytes(bundle()), bundle()).taken == strip.taken
    assert len(photographs[-1].descriptors) > 50
    assert not photographs[0].photograph.features or not photographs[0].photograph.features.outputs["ring"].any()


def test_damaged_entries_are_refused(photographs: list[AlbumPhotograph]) -> None:
    content = photographs[-1].to_bytes(bundle())
    rng = np.random.default_rng(0)
    damaged = [b"", b"LLAP", content[:100], content[:-7], content[:6] + b"\xff" * 4 + content[10:], b"x" * 30_000]
    for _ in range(60):
        changed = bytearray(content[: len(content) // 2])
        changed[int(rng.integers(len(changed)))] ^= int(rng.integers(1, 256))
        damaged.append(bytes(changed))
    for hostile in damaged:
        with pytest.raises((InvalidEntryError, InvalidFeaturesError, InvalidInputError)):
            read_entry(hostile, bundle())


def test_all_photographs_are_pinned_to_their_rooms(
    photographs: list[AlbumPhotograph], solved: tuple[Album, AlbumMemory, list[int]]
) -> None:
    album, _, seen = solved
    assert seen == [1, 2, 3, 4, 5]
    assert [pin.photograph_id for pin in album.pins] == list(NAMES)
    assert [pin.pose.room_id for pin in album.pins if pin.pose] == list(ROOMS)
    for pin in album.pins:
        assert 0.0 <= pin.within_1m <= pin.confidence <= 1.0
        assert pin.suggestions[0].pose == pin.pose
        assert len(pin.suggestions) <= 5
        assert sum(row.probability for row in pin.rooms) <= 1.0 + 1e-9
    assert sum(album.counts.values()) == len(photographs)
    assert 1.0 < present(album.camera_height_m) < 2.0
    assert album.cameras[0].photographs == 1


def test_field_of_view_of_a_strip_is_its_own(photographs: list[AlbumPhotograph]) -> None:
    own = photographs[-1].photograph
    strip = replace(own, projection="cylindrical", hfov=Assumed(value=math.radians(240.0), sd=0.1, source="gpano"))
    cameras = [shared_cameras([replace(photographs[-1], photograph=view)])[0] for view in (own, strip)]
    assert [camera.hfov for camera in cameras] == pytest.approx([own.hfov.value, math.radians(240.0)])


@pytest.mark.slow
def test_order_of_arrival_and_memory_give_the_same_pins(
    ground: AlbumGround, photographs: list[AlbumPhotograph], solved: tuple[Album, AlbumMemory, list[int]]
) -> None:
    album, memory, _ = solved
    assert solve_album(ground, encoder(), photographs[::-1]).pins == album.pins[::-1]
    seen: list[int] = []
    again = solve_album(ground, encoder(), photographs, memory=memory, progress=seen.append)
    assert seen == []
    assert again.pins == album.pins
    # What is stored is not found again, but for what is damaged.
    stored = {each.id: memory.to_bytes(each.id) for each in photographs} | {photographs[0].id: b"damaged"}
    again = solve_album(ground, encoder(), photographs, memory=AlbumMemory(stored=stored), progress=seen.append)
    assert seen == [len(photographs)]
    assert again.pins == album.pins


@pytest.mark.slow
def test_memory_of_another_plan_is_not_used(ground: AlbumGround, photographs: list[AlbumPhotograph]) -> None:
    memory = AlbumMemory()
    solve_album(ground, encoder(), photographs[:1], memory=memory)
    document = ground.plan.to_dict() | {"name": "changed"}
    changed = AlbumGround.of_plan("flat", FloorPlan.from_dict(document), ground.grid)
    seen: list[int] = []
    solve_album(changed, encoder(), photographs[:1], memory=memory, progress=seen.append)
    assert seen == [1]


def _without(photograph: AlbumPhotograph, id: str, *outputs: str) -> AlbumPhotograph:
    """Return a photograph whose walls or objects are not seen."""
    features = present(photograph.photograph.features)
    empty = {name: np.zeros_like(features.outputs[name]) for name in outputs}
    features = replace(features, outputs={**features.outputs, **empty})
    return replace(photograph, id=id, photograph=replace(photograph.photograph, features=features))


def test_photographs_without_walls_and_objects_are_set_aside(
    ground: AlbumGround, photographs: list[AlbumPhotograph]
) -> None:
    blank = [_without(photographs[-1], name, "seen", "object_probability") for name in ("façade", "garden")]
    outside = [replace(each, colours=np.roll(each.colours, 32)) for each in blank]
    untimed = [replace(each, taken=replace(each.taken, at=None)) for each in (*photographs, *outside)]
    pins = solve_album(ground, encoder(), untimed).pins
    assert [each.pose.room_id for each in pins[:-2] if each.pose] == list(ROOMS)
    for pin in pins[-2:]:
        assert (pin.state, pin.pose) == ("set_aside", None)
        assert "façades and gardens" in pin.reason


def test_names_of_files_tell_types_of_rooms_but_not_those_of_the_folder(
    ground: AlbumGround, photographs: list[AlbumPhotograph]
) -> None:
    blank = replace(
        _without(photographs[-1], "blank", "seen", "object_probability"), colours=np.zeros_like(photographs[-1].colours)
    )

    def share(name: str, others: str) -> float:
        album = [*(replace(each, name=others) for each in photographs), replace(blank, name=name)]
        pin = solve_album(ground, encoder(), album).pins[-1]
        return sum(row.probability for row in pin.rooms if row.room_id == "kitchen")

    plain = share("", "")
    assert share("Küche_03.jpg", "") > 2.0 * plain
    assert share("Kitchen Row 03.jpg", "Kitchen Row 01.jpg") == pytest.approx(plain, abs=0.03)


def test_photograph_that_shows_no_wall_is_not_sure(ground: AlbumGround, photographs: list[AlbumPhotograph]) -> None:
    blind = _without(photographs[-1], "blind", "seen")
    pin = solve_album(ground, encoder(), [blind]).pins[0]
    assert pin.state in ("set_aside", "uncertain")
    assert pin.within_1m < 0.2


def test_photograph_of_an_album_that_fits_badly_is_uncertain_and_not_set_aside(
    ground: AlbumGround, photographs: list[AlbumPhotograph], solved: tuple[Album, AlbumMemory, list[int]]
) -> None:
    memory, kitchen = solved[1], photographs[0]
    states = States.of(memory.evidence[kitchen.id], encoder().manifest.ring_sectors)
    rooms = len(ground.plan.rooms)
    share = np.append(np.full(rooms, 1e-4), 1.0 - 1e-4 * rooms)
    pins = [_pin_of(ground, kitchen, states, share, None, fits=fits, is_outside=False) for fits in (True, False)]
    assert [pin.state for pin in pins] == ["set_aside", "uncertain"]
    assert pins[1].confidence == pytest.approx(1e-4)


def test_album_that_fits_badly_says_so_and_has_no_sure_pin(
    ground: AlbumGround, photographs: list[AlbumPhotograph], solved: tuple[Album, AlbumMemory, list[int]]
) -> None:
    misread = {id: {**each, "rooms": np.full_like(each["rooms"], -8.0)} for id, each in solved[1].evidence.items()}
    album = solve_album(ground, encoder(), photographs, memory=AlbumMemory(key=solved[1].key, evidence=misread))
    assert "fit this plan badly" in album.warnings[0]
    assert {pin.state for pin in album.pins} == {"uncertain"}


def test_bias_of_a_compass_is_that_of_all_photographs(solved: tuple[Album, AlbumMemory, list[int]]) -> None:
    states = [States.of(evidence, encoder().manifest.ring_sectors) for evidence in solved[1].evidence.values()]
    compass = [float(state.heading[state.log.argmax()]) + 1.0 for state in states]
    biases = [by_compass(states, compass, north)[1] for north in (None, -1.1)]
    assert biases == pytest.approx([math.tau - 1.0] * 2, abs=0.1)


def test_unknown_room_and_repeated_id_are_refused(ground: AlbumGround, photographs: list[AlbumPhotograph]) -> None:
    correction = read_correction({"kind": "room", "plan_id": "flat", "room_id": "ballroom"})
    with pytest.raises(InvalidCorrectionError, match="room 'ballroom' of plan 'flat', which does not exist"):
        solve_album(ground, encoder(), [replace(photographs[0], correction=correction)])
    with pytest.raises(InvalidInputError, match="same id"):
        solve_album(ground, encoder(), [photographs[0], photographs[0]])
    assert solve_album(ground, encoder(), []).pins == ()


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"kind": "room", "plan_id": "p"}, "needs room_id"),
        ({"kind": "elsewhere", "x_m": 1.0}, "x_m does not go with"),
        ({"kind": "position", "plan_id": "p", "x_m": 1.0, "y_m": 2e9}, "between -100000 and 100000"),
        ({"kind": "elsewhere", "more": 1}, "no key 'more'"),
    ],
)
def test_impossible_corrections_are_refused(document: object, message: str) -> None:
    with pytest.raises(InvalidCorrectionError, match=message):
        read_correction(document)


def test_correction_survives_storage() -> None:
    correction = Correction(kind="confirmed", plan_id="p", x_m=1.0, y_m=2.0, heading_deg=3.0)
    assert read_correction(correction.to_document()) == correction


def test_evidence_of_photographs_of_one_spot_counts_once() -> None:
    logs = np.random.default_rng(2).normal(2.0, 1.0, (3, 6))
    pose, room = np.arange(6), np.array([0, 0, 0, 1, 1, 1])
    states = [
        States.of(
            {
                "pose": pose,
                "position_m": np.zeros((6, 2)),
                "room": room,
                "hypothesis": 0 * pose,
                "log_likelihood": log,
                "rooms": np.logaddexp.reduce(log.reshape(2, 3), axis=1) - math.log(3.0),
            },
            128,
        )
        for log in logs
    ]
    turned = turned_together(states, {(0, 1): 0.0, (0, 2): 0.0, (1, 2): 0.0}, 6)
    of_rooms = np.array([state.evidence(1e-9) for state in turned])
    # All three together have the evidence of their common poses, once.
    total = np.logaddexp.reduce(logs.sum(axis=0).reshape(2, 3), axis=1) - math.log(3.0)
    np.testing.assert_allclose(of_rooms.sum(axis=0), total, atol=0.3)
    # What a photograph says against a room is bounded by its being misread.
    assert turned[0].evidence(0.2).min() >= math.log(0.2)


def test_share_of_misread_photographs_is_found_in_the_album() -> None:
    assert misread_share([np.full(6, 4.0)] * 40, 0.2) < 0.1
    assert misread_share([np.full(6, -4.0)] * 40, 0.2) > 0.5
    # Photographs that tell nothing leave it as it is.
    assert misread_share([np.zeros(6)] * 40, 0.2) == pytest.approx(0.2)


def test_probabilities_of_rooms_are_calibrated_and_keep_their_order() -> None:
    weights = replace(AlbumWeights(), confidence=(1.5, 0.8, -7.0))
    share = np.array([[0.6, 0.3, 0.05, 0.05], [0.4, 0.2, 0.0, 0.4], [0.2, 0.1, 0.1, 0.6]])
    fits, misfits = (calibrated(share, misread, weights) for misread in (0.1, 0.5))
    for found in (fits, misfits):
        np.testing.assert_array_equal(found[:, :3].argmax(axis=1), 0)
        assert (found.sum(axis=1) <= 1.0 + 1e-9).all()
        # Whether a photograph is set aside does not depend on how well the others fit.
        np.testing.assert_array_equal(found[2], share[2])
        assert found[1, 3] <= 0.4
    log_odds = 1.5 + 0.8 * math.log(0.6 / 0.4) - 0.7
    assert fits[0, 0] == pytest.approx(1.0 / (1.0 + math.exp(-log_odds)))
    assert misfits[0, 0] < 0.2 < share[0, 0] < fits[0, 0]
    np.testing.assert_allclose(calibrated(share, 0.3, replace(weights, confidence=(0.0, 1.0, 0.0))), share)


def test_figures_of_pins_count_rooms_and_elsewhere() -> None:
    share = RoomShare(plan_id="p", room_id="a", room="A", probability=0.9)
    pose = PinPose(plan_id="p", room_id="a", room="A", x_m=0.0, y_m=0.0, heading=None)
    pins = [replace(_pin(str(number), pose), rooms=(share,)) for number in range(3)]
    pins[2] = replace(pins[2], elsewhere=0.1)
    pins.append(replace(_pin("4", None), state="set_aside", elsewhere=1.0))
    figures = pin_figures(pins, [("p", "a"), ("p", "b"), None, None])
    assert figures == {
        "n": 2, "right_room": 1, "set_aside": 0, "sure": 2, "sure_and_wrong": 1,
        "elsewhere": 2, "elsewhere_sure": 1, "elsewhere_set_aside": 1,
        "mean_log_probability": pytest.approx((math.log(0.9) + math.log(1e-3) + math.log(0.1)) / 4),
    }  # fmt: skip


def test_photographs_that_all_look_alike_are_not_drawn_into_one_room() -> None:
    count = 30
    alone = np.tile([0.0, 1.0, -9.0], (count, 1))
    alone[::2] = 1.0, 0.0, -9.0
    pairs = 0.5 * (1.0 - np.eye(count))
    evidence = RoomEvidence(alone=alone, walk=None, follows=np.zeros(count, bool), pairs=pairs, expected=None)
    share = assign_rooms(evidence)
    assert min(share[::2, 0].mean(), share[1::2, 1].mean()) > 0.6


def _exhaustive(evidence: RoomEvidence) -> np.ndarray:
    """Sum over all assignments."""
    count, rooms = evidence.alone.shape
    total = np.zeros((count, rooms))
    for code in range(rooms**count):
        room = np.array([code // rooms**number % rooms for number in range(count)])
        log = evidence.alone[np.arange(count), room].sum()
        if evidence.walk is not None:
            log += (evidence.walk[room[:-1], room[1:]] * evidence.follows[1:]).sum()
        counts = np.bincount(room, minlength=rooms)
        within = 0.5 * (evidence.pairs * (room[:, None] == room) * (room < rooms - 1)).sum(axis=1)
        log += (within * np.minimum(PARTNERS / np.maximum(counts[room] - 1, 1), 1.0)).sum()
        if evidence.expected is not None:
            expected = counts[:-1].sum() * evidence.expected
            log -= (evidence.crowding * np.square(counts[:-1] - expected) / (2.0 * (expected + 1.0))).sum()
        # One of n photographs is of none of the rooms, given the others, as often as 1 + k in 10 + n - 1.
        log += math.log(math.prod(range(1, counts[-1] + 1)) * math.prod(range(9, 9 + counts[:-1].sum())))
        total[np.arange(count), room] += math.exp(log)
    return total / total.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("has_order", [True, False])
def test_assignment_agrees_with_the_sum_over_all(has_order: bool) -> None:
    rng = np.random.default_rng(3)
    pairs = rng.normal(0.0, 1.5, (6, 6))
    pairs = np.triu(pairs, 1) + np.triu(pairs, 1).T
    walk = np.log(rng.dirichlet(np.ones(3), 3)) if has_order else None
    evidence = RoomEvidence(
        alone=rng.normal(0.0, 1.0, (6, 3)),
        walk=walk,
        # Two walks, of two photographs and of four.
        follows=np.array([False, True, False, True, True, True]) & has_order,
        pairs=pairs,
        expected=np.array([0.5, 0.5]),
        storeys=(np.array([0]), np.array([1])),
    )
    mean = np.mean([assign_rooms(evidence, seed) for seed in range(6)], axis=0)
    np.testing.assert_allclose(mean, _exhaustive(evidence), atol=0.05)


def test_storeys_that_were_confused_are_exchanged() -> None:
    """Two storeys of four rooms look alike, and the first of sixteen photographs tells them apart."""
    rooms, count = 8, 16
    alone = np.full((count, rooms + 1), -12.0)
    for number in range(count):
        alone[number, [number // 4, number // 4 + 4]] = 0.0, 0.6
    alone[0, 4:] = -6.0
    walk = np.full((rooms + 1, rooms + 1), math.log(1e-9))
    walk[:4, :4], walk[4:8, 4:8] = math.log(0.25), math.log(0.25)
    follows, storeys = np.arange(count) > 0, (np.arange(4), np.arange(4, 8))
    evidence = RoomEvidence(
        alone=alone, walk=walk, follows=follows, pairs=np.zeros((count, count)), expected=None, storeys=storeys
    )
    found = [assign_rooms(evidence, seed)[:, 4:8].sum(axis=1).mean() for seed in range(4)]
    # By the sum over both: -6 for the first photograph against 15 times 0.6.
    np.testing.assert_allclose(found, 1.0 / (1.0 + math.exp(6.0 - 15 * 0.6)), atol=0.05)


def _pin(id: str, pose: PinPose | None) -> Pin:
    return Pin(photograph_id=id, state="sure", pose=pose, confidence=1.0, within_1m=1.0)


def test_moved_pins_are_those_that_moved_far_or_changed_their_room() -> None:
    pose = PinPose(plan_id="p", room_id="a", room="A", x_m=0.0, y_m=0.0, heading=None)
    before = [_pin(id, pose) for id in ("near", "far", "room", "gone", "plan")]
    after = [
        _pin("near", replace(pose, x_m=0.4)),
        _pin("far", replace(pose, x_m=0.6)),
        _pin("room", replace(pose, room_id="b")),
        _pin("gone", None),
        _pin("plan", replace(pose, plan_id="q")),
        _pin("new", pose),
    ]
    moved = {each.photograph_id: (each.distance_m, each.new_room) for each in moved_pins(before, after)}
    assert moved == {"far": (0.6, False), "room": (0.0, True), "gone": (None, True), "plan": (None, True)}


@pytest.mark.slow
def test_places_that_are_too_large_are_refused(photographs: list[AlbumPhotograph]) -> None:
    squares = [
        {"polygon": [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]]}
        for x, y in (divmod(number, 40) for number in range(MAX_ROOMS + 1))
    ]
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": squares})
    grid = build_grid(plan, encoder().layouts, step_m=1.0, camera_height_m=1.5, latents=False)
    ground = AlbumGround.of_plan("large", plan, grid)
    with pytest.raises(InvalidInputError, match=r"1001 rooms and .* at most 1000 rooms"):
        solve_album(ground, encoder(), photographs)
