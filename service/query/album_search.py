"""Albums: entries of their photographs, and one solve for all of them in a plan or in plans of a venue."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from time import thread_time

from lalaloc_core.errors import InvalidInputError, InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.entry import AlbumPhotograph, photograph_entry, read_correction, read_entry
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.localise.album.ground import AlbumGround
from lalaloc_core.localise.album.solve import solve_album
from lalaloc_core.localise.answers.documents import Spot
from lalaloc_core.localise.encode.features import encodes_spheres
from lalaloc_core.localise.query import Query
from lalaloc_core.localise.query.query import UNKNOWN_HEADING
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from service.bounded_cache import BoundedCache
from service.capacity.admission_control import Slots
from service.capacity.fair_share import FairSemaphore
from service.capacity.threads import Threads, charge_until_now
from service.query.album_answers import compose_outcome
from service.query.ground import Ground
from service.query.grounds import spread
from service.query.queries import AlbumEntry, AlbumOutcome, AlbumPhotographQuery, AlbumQuery, Where
from service.query.single_query import QueryParts
from service.schemas.albums import AlbumDocument, PhotographFacts
from service.storage.album_jobs import AlbumPart
from service.storage.records import PlanRecord, VenueRecord

# Albums solved at a time by a replica, one per tenant, each on a thread: none waits for the end of another tenant's.
AT_A_TIME = 4
# Memory of what solves found about single photographs, all albums together.
_MEMORY_BYTES = 256 * 2**20
# CPU time (s) of an album until it is solved, in all its turns; the largest ones need some minutes.
_MAX_CPU_S = 3600.0


class _Stopped(Exception):
    """The caller does not want the solution any more."""


class AlbumSearch:
    """Solver of albums, on threads of its own: a solve can take longer than queries may wait.

    A solve holds one of the `turns` and of the `cores` while it computes, and passes them on after each photograph.
    """

    def __init__(
        self, parts: QueryParts, queries: Slots, threads: Threads, turns: FairSemaphore, cores: FairSemaphore
    ) -> None:
        self._parts, self._queries, self._threads, self._turns, self._cores = parts, queries, threads, turns, cores
        # Found by an earlier solve of the same album; a solve takes it out, as two must not share it.
        self._memories = BoundedCache[str, AlbumMemory](_MEMORY_BYTES, _size_of)

    async def entry(self, where: Where, query: AlbumPhotographQuery) -> AlbumEntry:
        """Return what an album keeps of a photograph; raises the errors of decoding and encoding."""
        content, document, context = query.content, query.document, query.context
        with context.clock.stage("decode"):
            view = await self._parts.decoder.decode(content, document.stated_camera, context, purpose="album")
        if view.sphere is not None and not encodes_spheres(self._parts.bundle.manifest):
            raise InvalidPhotographError("the photograph is a full sphere, of which the model gives no features")

        def encode() -> AlbumEntry:
            made = photograph_entry(query.sha256, self._parts.encoder.with_features(view))
            taken = made.taken
            facts = PhotographFacts(
                taken_at=None if taken.at is None else taken.at.replace(tzinfo=None).isoformat(),
                make=taken.make or None,
                model=taken.model or None,
                width=taken.width or None,
                height=taken.height or None,
                **Spot(made.photograph).view.document(),
            )
            return AlbumEntry(made.to_bytes(self._parts.bundle), facts.model_dump_json())

        with context.clock.stage("encode"):
            return await self._parts.executor.compute(context, encode)

    async def solve(self, where: PlanRecord | VenueRecord, query: AlbumQuery) -> AlbumOutcome:
        """Pin the photographs of an album."""
        context, document = query.context, query.document
        # Not on the event loop: the entries of 500 photographs have megabytes.
        photographs = await self._threads.run(context.client, partial(self._read, query.photographs))
        async with self._queries.wait_and_hold(context.client, context.deadline):
            site = await self._parts.grounds.site(where, document)
            await site.wait(context)
            chosen: list[Query] = []
            if isinstance(where, VenueRecord):
                spots = [Spot(entry.photograph) for entry in spread(photographs)]
                known, heights = [UNKNOWN_HEADING] * len(spots), [site.height] * len(spots)
                chosen = await self._parts.reader.encode(spots, known, heights, context)
            ground = await site.ground(chosen, context)
        work = partial(self._solve, query, ground, photographs)
        return await self._threads.run(context.client, work)

    def _read(self, parts: Sequence[AlbumPart]) -> list[AlbumPhotograph]:
        return [replace(read_entry(part.entry, self._parts.bundle), name=part.name or "") for part in parts]

    def _solve(self, query: AlbumQuery, ground: Ground, photographs: Sequence[AlbumPhotograph]) -> AlbumOutcome:
        places = _album_ground(ground, query.document)
        dropped = dict[str, str]()
        stated = list[AlbumPhotograph]()
        # Entries have the digests of the files, by which the same folder gets the same pins as on the command line.
        parts = {entry.id: part for entry, part in zip(photographs, query.photographs, strict=True)}
        for entry, part in zip(photographs, parts.values(), strict=True):
            correction = None if part.correction is None else read_correction(json.loads(part.correction))
            if correction and (fault := _misfit(places, correction.plan_id, correction.room_id)) is not None:
                dropped[part.id], correction = fault, None
            stated.append(replace(entry, correction=correction))
        stored = {id: part.evidence for id, part in parts.items() if part.evidence is not None}
        memory = self._memories.pop(query.album_id) or AlbumMemory(stored=stored)
        begin_s, memory.spent_s, client = thread_time() - memory.spent_s, 0.0, query.context.client

        def progress(done: int) -> None:
            query.progress.share = done / max(len(stated), 1)
            newest = next(reversed(memory.evidence))
            query.progress.found[parts[newest].id] = memory.to_bytes(newest)

        def pause() -> None:
            # Others that wait for the core and used less lately compute in between.
            charge_until_now()
            held.close()
            self._turns.give_way(client)
            held.enter_context(self._cores.hold(client))
            # Looked at last: of several solves that stop and wait for each other, none computes any more.
            spent_s = thread_time() - begin_s
            if query.progress.stopped:
                memory.spent_s = spent_s
                raise _Stopped
            if spent_s > _MAX_CPU_S:
                raise InvalidInputError(f"it took {_MAX_CPU_S:g} s of CPU time, which is the limit: divide the album")

        try:
            with self._turns.hold(client), ExitStack() as held:
                held.enter_context(self._cores.hold(client))
                album = solve_album(places, self._parts.encoder, stated, memory=memory, progress=progress, pause=pause)
        finally:
            # The next attempt goes on from here.
            self._memories.put(query.album_id, memory)
        pins = tuple(replace(pin, photograph_id=parts[pin.photograph_id].id) for pin in album.pins)
        album = replace(album, pins=pins)
        before = {part.id: part.pin for part in query.photographs}
        return compose_outcome(
            album, ground, before, dropped, places.plan.camera_height_m, is_same_place=query.is_same_place
        )

    def close(self) -> None:
        """Wait for the solves in progress."""
        self._threads.close()


def _size_of(memory: AlbumMemory) -> int:
    return sum(array.nbytes for arrays in memory.evidence.values() for array in arrays.values()) + 100 * len(
        memory.links
    )


def _album_ground(ground: Ground, document: AlbumDocument) -> AlbumGround:
    """Return the ground for the core; a stated camera height takes the place of the plans' own."""

    def stated(plan: FloorPlan) -> FloorPlan:
        if document.camera_height_m is None:
            return plan
        std_m = plan.camera_height_std_m if document.camera_height_std_m is None else document.camera_height_std_m
        return replace(
            plan, camera_height_m=document.camera_height_m, camera_height_std_m=std_m, states_camera_height=True
        )

    ids = tuple(record.id for record in ground.records)
    merged = ground.merged or MergedPlans.of_plan(ground.plan, ground.grid)
    return AlbumGround(ids, replace(merged, plans=tuple(map(stated, merged.plans)), plan=stated(merged.plan)))


def _misfit(places: AlbumGround, plan_id: str | None, room_id: str | None) -> str | None:
    """Return why a correction does not fit the plans; None if it does."""
    if plan_id is None:
        return None
    if plan_id not in places.plan_ids:
        return "its correction was left out: its floor plan is not searched any more"
    if room_id is not None and places.room_of(plan_id, room_id) is None:
        return f"its correction was left out: the floor plan has no room '{room_id[:64]}' any more"
    return None
