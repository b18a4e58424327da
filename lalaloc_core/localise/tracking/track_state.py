"""State of a tracked camera between two photographs, of bounded size, and its form in bytes."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.errors import InvalidStateError
from lalaloc_core.localise.tracking.walk_motion import States

Mode = Literal["searching", "tracking", "lost"]
Component = Literal["forward_m", "right_m", "turn_deg"]
COMPONENTS: tuple[Component, ...] = get_args(Component)
# Largest number of states of a belief.
MAX_STATES = 4096
# Probability, before the first photograph, that the camera is in the plan.
_IN_PLAN = 0.9
# Recent photographs of which contradicted motions are remembered.
_RECENT = 8
# Version 1 was of one plan, and ended with a path.
_MAGIC, _VERSIONS, _HEADER = b"LTRK", (1, 2), struct.Struct("<4sHI")
_MAX_BYTES = 2**20


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """Pose of a photograph.

    Attributes:
        heading: azimuth (radians) of the photograph's centre.
        covariance: of (x, y, heading), in m² and radians².
        room_index: number of the room in its plan; x, y and the heading are in the frame of that plan.
        probability: that the pose is right within 1 m.
        mode: mode of the session after the photograph.
        number: number of the photograph, from 1.
        sure: whether the photograph by itself tells this pose.
        plan: number of the plan in `TrackState.plans`, or in `TrackedPlans` while it is tracked.
    """

    x_m: float
    y_m: float
    heading: float
    covariance: Float[np.ndarray, "3 3"]
    room_index: int
    probability: float
    mode: Mode
    number: int
    # States of earlier versions have neither.
    sure: bool = False
    plan: int = 0

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """(x, y) as an array."""
        return np.array([self.x_m, self.y_m])


@dataclass(frozen=True)
class StatePlan:
    """Plan that a state has poses in: its key, which changes with the plan, and the number of its grid poses."""

    key: str
    poses: int


@dataclass(frozen=True, eq=False)
class TrackState:
    """State after some photographs; `TrackState.first` is that before the first one.

    Attributes:
        plans: plans of the belief and the pose; their grids must not change.
        sectors: number of sectors of the heading.
        belief: the probable states, with poses numbered through all plans; the sum of their weights is at most one,
            and the rest is anywhere.
        in_plan: probability that the camera is in a plan.
        number: photographs so far.
        pose: pose of the last photograph; None before the first, and if its plan is not tracked.
        contradicted: for each component of the motions, bits of the recent photographs that contradict it.
    """

    plans: tuple[StatePlan, ...]
    sectors: int
    belief: States
    in_plan: float = _IN_PLAN
    number: int = 0
    pose: TrackedPose | None = None
    contradicted: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def first(cls, sectors: int) -> TrackState:
        """Return the state before the first photograph: the camera is anywhere."""
        nothing = np.empty(0, np.int64)
        return cls((), sectors, States(nothing, nothing, np.empty(0)))

    @property
    def plan_of_state(self) -> Int[np.ndarray, "m"]:
        """Number of the plan of each state of the belief."""
        ends = np.cumsum([plan.poses for plan in self.plans])
        return np.searchsorted(ends, self.belief.pose, side="right")

    @property
    def by_plan(self) -> dict[str, float]:
        """Probability of each plan, by key."""
        weight = np.bincount(self.plan_of_state, self.belief.weight, minlength=len(self.plans))
        return {plan.key: float(share) for plan, share in zip(self.plans, weight, strict=True)}

    def with_sectors(self, sectors: int) -> TrackState:
        """Return the state with another number of sectors of the heading, as views have more of them than spheres."""
        if sectors == self.sectors:
            return self
        ratio = sectors / self.sectors
        off = np.arange(self.sectors)[:, None] * ratio - np.arange(sectors)
        off = np.abs((off + 0.5 * sectors) % sectors - 0.5 * sectors)
        share = np.maximum(1.0 - off / max(ratio, 1.0), 0.0)
        share /= share.sum(axis=1, keepdims=True)
        row, sector = np.nonzero(share[self.belief.sector])
        weight = self.belief.weight[row] * share[self.belief.sector[row], sector]
        return replace(self, sectors=sectors, belief=States(self.belief.pose[row], sector, weight))

    @property
    def suspected(self) -> tuple[Component, ...]:
        """Components of the motions that at least three of the recent photographs contradict."""
        return tuple(name for name, bits in zip(COMPONENTS, self.contradicted, strict=True) if bits.bit_count() >= 3)

    def judged(self, missed: tuple[Component, ...]) -> TrackState:
        """Return the state after a photograph that contradicts some components of its motion."""
        mask = (1 << _RECENT) - 1
        first, second, third = (
            ((bits << 1) | (name in missed)) & mask for name, bits in zip(COMPONENTS, self.contradicted, strict=True)
        )
        return replace(self, contradicted=(first, second, third))

    def to_bytes(self) -> bytes:
        """Return the state as bytes, at most about 100 kB."""
        pose, belief = self.pose, self.belief
        header: dict[str, Any] = {
            "plans": [[plan.key, plan.poses] for plan in self.plans],
            "sectors": self.sectors,
            "in_plan": self.in_plan,
            "number": self.number,
            "contradicted": list(self.contradicted),
            "states": len(belief.pose),
            "pose": None
            if pose is None
            else {**vars(pose), "covariance": np.asarray(pose.covariance, float).ravel().tolist()},
        }
        text = json.dumps(header).encode()
        arrays = ((belief.pose * self.sectors + belief.sector).astype("<i4"), belief.weight.astype("<f4"))
        content = struct.pack("<I", len(text)) + text + b"".join(part.tobytes() for part in arrays)
        # Level 1, because most of the content hardly shrinks.
        return _HEADER.pack(_MAGIC, _VERSIONS[-1], zlib.crc32(content)) + zlib.compress(content, 1)

    @classmethod
    def from_bytes(cls, content: bytes) -> TrackState:
        """Read a state.

        Raises:
            InvalidStateError: the bytes are not a state, or of another version.
        """
        try:
            return _read(content)
        except (KeyError, TypeError, ValueError, OverflowError, struct.error, zlib.error) as error:
            raise InvalidStateError(f"the state of the session is damaged: {error}") from error


def _read(content: bytes) -> TrackState:
    magic, version, checksum = _HEADER.unpack_from(content)
    if magic != _MAGIC or version not in _VERSIONS:
        raise InvalidStateError(
            f"the state has version {version}; this version of the service reads {', '.join(map(str, _VERSIONS))}"
        )
    body = zlib.decompressobj().decompress(content[_HEADER.size :], _MAX_BYTES)
    if zlib.crc32(body) != checksum:
        raise InvalidStateError("the state of the session is damaged: its checksum differs")
    (length,) = struct.unpack_from("<I", body)
    header = json.loads(body[4 : 4 + length])
    states, first = int(header["states"]), 4 + length
    if not 0 <= states <= MAX_STATES:
        raise InvalidStateError(f"the state has {states} states; the limit is {MAX_STATES}")
    plans = tuple(StatePlan(key, int(poses)) for key, poses in header.get("plans", [["", header.get("poses")]]))
    number = np.frombuffer(body, "<i4", states, first).astype(np.int64)
    weight = np.frombuffer(body, "<f4", states, first + 4 * states).astype(np.float64)
    poses, sectors = sum(plan.poses for plan in plans), int(header["sectors"])
    if states and not (number.min() >= 0 and number.max() < poses * sectors and (weight >= 0.0).all()):
        raise InvalidStateError("the state of the session is damaged: a weight or a pose is out of range")
    pose = header["pose"]
    if pose is not None:
        pose = TrackedPose(**{**pose, "covariance": np.array(pose["covariance"]).reshape(3, 3)})
        if not 0 <= pose.plan < len(plans):
            raise InvalidStateError("the state of the session is damaged: the plan of its pose is out of range")
    misses = [int(bits) for bits in header["contradicted"]]
    return TrackState(
        plans,
        sectors,
        States(number // sectors, number % sectors, weight),
        float(header["in_plan"]),
        int(header["number"]),
        pose,
        (misses[0], misses[1], misses[2]),
    )
