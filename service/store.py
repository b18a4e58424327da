"""What persists: floor plans, their uploaded originals, and latent grids. One transaction per call.

A grid belongs to one plan, model, grid step and camera height; another model or step simply does not find it.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import numpy as np
from sqlalchemy import (
    DDL,
    DateTime,
    Engine,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    String,
    Text,
    UniqueConstraint,
    create_engine,
    delete,
    event,
    func,
    select,
    update,
)
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, IntegrityError, SQLAlchemyError
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import FloorPlan, PlanLimits
from lalaloc_core.localise.poses import LatentGrid
from lalaloc_core.sampling import PoseSet
from service.errors import TooManyFloorPlansError

# A stored plan was valid under the limits of its day; tighter limits must not make it unreadable.
_STORED_LIMITS = PlanLimits(max_rooms=10**9, max_vertices_per_room=10**9, max_extent_m=math.inf)
_PARSED_PLANS = 64
# Tables of grids in older formats: they are dropped, and their grids computed again.
_OLDER_GRIDS = ("latent_grids",)


class _Base(DeclarativeBase):
    pass


class _PlanRow(_Base):
    __tablename__ = "floorplans"

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    created_at: Mapped[datetime] = mapped_column(DateTime(timezone=True))
    name: Mapped[str] = mapped_column(Text)
    document: Mapped[str] = mapped_column(Text)
    room_count: Mapped[int] = mapped_column(Integer)
    area_m2: Mapped[float] = mapped_column(Float)
    camera_height_m: Mapped[float] = mapped_column(Float)
    failure: Mapped[str | None] = mapped_column(Text)

    __table_args__ = (Index("floorplans_by_age", "created_at", "id"),)


class _OriginalRow(_Base):
    __tablename__ = "originals"

    plan_id: Mapped[str] = mapped_column(ForeignKey("floorplans.id", ondelete="CASCADE"), primary_key=True)
    content: Mapped[bytes] = mapped_column(LargeBinary)


class _GridRow(_Base):
    # What a grid holds has changed once; see `_OLDER_GRIDS`.
    __tablename__ = "latent_grids_2"

    id: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    plan_id: Mapped[str] = mapped_column(ForeignKey("floorplans.id", ondelete="CASCADE"))
    model_sha256: Mapped[str] = mapped_column(String(64))
    step_m: Mapped[float] = mapped_column(Float)
    camera_height_mm: Mapped[int] = mapped_column(Integer)
    poses: Mapped[int] = mapped_column(Integer)
    arrays: Mapped[bytes] = mapped_column(LargeBinary)

    __table_args__ = (UniqueConstraint("plan_id", "model_sha256", "step_m", "camera_height_mm"),)


@dataclass(frozen=True, kw_only=True)
class GridKey:
    """Which latent grid: of one plan, for one model, grid step and camera height."""

    plan_id: str
    model_sha256: str
    step_m: float
    camera_height_mm: int

    @property
    def camera_height_m(self) -> float:
        """The camera height in metres."""
        return self.camera_height_mm / 1000.0

    def where(self) -> list[Any]:
        """The key as conditions on the table of grids."""
        return [
            _GridRow.plan_id == self.plan_id,
            _GridRow.model_sha256 == self.model_sha256,
            _GridRow.step_m == self.step_m,
            _GridRow.camera_height_mm == self.camera_height_mm,
        ]


@dataclass(frozen=True, kw_only=True)
class PlanRecord:
    """A stored floor plan.

    Attributes:
        failure: why its latent grid could not be computed last time, None when that did not happen.
    """

    id: str
    created_at: datetime
    plan: FloorPlan
    failure: str | None


@dataclass(frozen=True, kw_only=True)
class PlanSummary:
    """A stored floor plan without its rooms; what `PlanRecord` says, and what listings need."""

    id: str
    created_at: datetime
    name: str
    room_count: int
    area_m2: float
    camera_height_m: float
    failure: str | None


class Store:
    """The database; safe to share between threads and between processes."""

    def __init__(self, url: str) -> None:
        """Connect, create missing tables, and drop those of older formats that hold nothing but what can be computed.

        Raises:
            ConfigError: not a usable database URL, or the database cannot be opened.
        """
        try:
            self._engine = _engine(url)
            _Base.metadata.create_all(self._engine)
            with self._engine.begin() as connection:
                for name in _OLDER_GRIDS:
                    connection.execute(DDL(f"DROP TABLE IF EXISTS {name}"))
        except (ArgumentError, ImportError, OSError, SQLAlchemyError) as error:
            raise ConfigError(f"cannot open the database: {error}") from error
        # A plan never changes once stored, so its text stands for it.
        self._parse = lru_cache(maxsize=_PARSED_PLANS)(lambda text: FloorPlan.from_json(text, _STORED_LIMITS))

    def close(self) -> None:
        """Give all connections back."""
        self._engine.dispose()

    def add_plan(self, plan_id: str, plan: FloorPlan, *, original: bytes, limit: int) -> PlanRecord:
        """Store a plan and the bytes it was uploaded as.

        Raises:
            TooManyFloorPlansError: `limit` plans are stored already.
        """
        created_at = datetime.now(UTC)
        with self._transaction() as session:
            if (session.scalar(select(func.count()).select_from(_PlanRow)) or 0) >= limit:
                raise TooManyFloorPlansError(limit)
            session.add(
                _PlanRow(
                    id=plan_id,
                    created_at=created_at,
                    name=plan.name,
                    document=json.dumps(plan.to_dict()),
                    room_count=len(plan.rooms),
                    area_m2=plan.area_m2,
                    camera_height_m=plan.camera_height_m,
                )
            )
            session.flush()
            session.add(_OriginalRow(plan_id=plan_id, content=original))
        return PlanRecord(id=plan_id, created_at=created_at, plan=plan, failure=None)

    def plan(self, plan_id: str) -> PlanRecord | None:
        """A plan by its id."""
        with self._transaction() as session:
            row = session.get(_PlanRow, plan_id)
            if row is None:
                return None
            return PlanRecord(
                id=row.id,
                created_at=_utc(row.created_at),
                plan=self._parse(row.document),
                failure=row.failure,
            )

    def original(self, plan_id: str) -> bytes | None:
        """The bytes a plan was uploaded as."""
        with self._transaction() as session:
            row = session.get(_OriginalRow, plan_id)
            return None if row is None else row.content

    def plans(self, *, offset: int = 0, limit: int | None = None) -> list[PlanSummary]:
        """Stored plans, newest first."""
        query = select(
            _PlanRow.id,
            _PlanRow.created_at,
            _PlanRow.name,
            _PlanRow.room_count,
            _PlanRow.area_m2,
            _PlanRow.camera_height_m,
            _PlanRow.failure,
        )
        query = query.order_by(_PlanRow.created_at.desc(), _PlanRow.id).offset(offset)
        with self._transaction() as session:
            return [
                PlanSummary(
                    id=row.id,
                    created_at=_utc(row.created_at),
                    name=row.name,
                    room_count=row.room_count,
                    area_m2=row.area_m2,
                    camera_height_m=row.camera_height_m,
                    failure=row.failure,
                )
                for row in session.execute(query if limit is None else query.limit(limit))
            ]

    def plan_count(self) -> int:
        """Number of stored plans."""
        with self._transaction() as session:
            return session.scalar(select(func.count()).select_from(_PlanRow)) or 0

    def delete_plan(self, plan_id: str) -> bool:
        """Delete a plan with its original and grids; False when there was none."""
        with self._transaction() as session:
            deleted = session.scalar(delete(_PlanRow).where(_PlanRow.id == plan_id).returning(_PlanRow.id))
            return deleted is not None

    def set_failure(self, plan_id: str, reason: str | None) -> None:
        """Record why a plan's latent grid could not be computed, or that it can."""
        with self._transaction() as session:
            session.execute(update(_PlanRow).where(_PlanRow.id == plan_id).values(failure=reason))

    def grid(self, key: GridKey) -> LatentGrid | None:
        """A latent grid, None when it is not stored (or not readable, then it has to be computed again)."""
        with self._transaction() as session:
            arrays = session.scalar(select(_GridRow.arrays).where(*key.where()))
        return None if arrays is None else _unpack(arrays, key)

    def grid_poses(
        self, model_sha256: str, step_m: float, plan_ids: list[str] | None = None
    ) -> dict[tuple[str, int], int]:
        """Number of poses of the stored grids of a model, by plan id and camera height (mm); of all plans, or some."""
        query = select(_GridRow.plan_id, _GridRow.camera_height_mm, _GridRow.poses).where(
            _GridRow.model_sha256 == model_sha256, _GridRow.step_m == step_m
        )
        if plan_ids is not None:
            query = query.where(_GridRow.plan_id.in_(plan_ids))
        with self._transaction() as session:
            return {(row.plan_id, row.camera_height_mm): row.poses for row in session.execute(query)}

    def put_grid(self, key: GridKey, grid: LatentGrid, *, keep: int, always_keep_mm: int) -> bool:
        """Store a grid; drop the plan's grids of other models or steps, and the oldest beyond `keep`.

        Args:
            always_keep_mm: the camera height (mm) that is never dropped to make room.

        Returns:
            False when the plan is gone, then nothing is stored.
        """
        try:
            with self._transaction() as session:
                if session.get(_PlanRow, key.plan_id) is None:
                    return False
                own = _GridRow.plan_id == key.plan_id
                current = (_GridRow.model_sha256 == key.model_sha256) & (_GridRow.step_m == key.step_m)
                session.execute(delete(_GridRow).where(own, ~current))
                session.execute(delete(_GridRow).where(*key.where()))
                on_demand = select(_GridRow.id).where(own, _GridRow.camera_height_mm != always_keep_mm)
                surplus = list(session.scalars(on_demand.order_by(_GridRow.id.desc()).offset(max(keep - 2, 0))))
                if key.camera_height_mm != always_keep_mm:
                    session.execute(delete(_GridRow).where(_GridRow.id.in_(surplus)))
                session.add(
                    _GridRow(
                        plan_id=key.plan_id,
                        model_sha256=key.model_sha256,
                        step_m=key.step_m,
                        camera_height_mm=key.camera_height_mm,
                        poses=len(grid.poses),
                        arrays=_pack(grid),
                    )
                )
        except IntegrityError:
            # Another process stored the same grid, or deleted the plan, between our statements.
            return self.plan(key.plan_id) is not None
        return True

    @contextmanager
    def _transaction(self) -> Iterator[Session]:
        with Session(self._engine, expire_on_commit=False) as session, session.begin():
            yield session


def _engine(url: str) -> Engine:
    parsed = make_url(url)
    engine = create_engine(parsed)
    if parsed.get_backend_name() == "sqlite":
        event.listen(engine, "connect", _prepare_sqlite)
    return engine


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # WAL lets readers go on while a grid is written; foreign keys are off in SQLite unless asked for.
    cursor = connection.cursor()
    for pragma in ("busy_timeout=5000", "journal_mode=WAL", "foreign_keys=ON", "synchronous=NORMAL"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _utc(moment: datetime) -> datetime:
    """SQLite forgets the time zone; all times are stored as UTC."""
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def _pack(grid: LatentGrid) -> bytes:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        position_m=grid.poses.position_m,
        room_index=grid.poses.room_index.astype(np.int32),
        latents=grid.latents.astype(np.float32),
        profile_m=grid.profile_m.astype(np.float32),
    )
    return buffer.getvalue()


def _unpack(content: bytes, key: GridKey) -> LatentGrid | None:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            poses = PoseSet(arrays["position_m"], arrays["room_index"].astype(np.int64))
            latents, profile_m = arrays["latents"], arrays["profile_m"]
    except (ValueError, KeyError, OSError, EOFError):
        return None
    if not (len(poses.position_m) == len(poses.room_index) == len(latents) == len(profile_m)):
        return None
    return LatentGrid(poses, latents, profile_m, key.step_m, key.camera_height_m)
