"""Code scan: prototypes as product codes of 25 bytes, compared through lookup tables (IVF-PQ fast-scan of faiss).

The cost of a prototype is a sum over its azimuths, its ceiling and its room type. A product code quantises each part to
4 bits, and the query computes the cost of all 16 values of each part once, in a lookup table. The approximate cost of a
code is then the sum of one entry per part (asymmetric distance; Jégou et al., *Product quantization for nearest
neighbor search*, 2011). Tables of 16 entries fit a SIMD register (André et al., *Cache locality is not enough*, 2015):
a core compares more than half a billion codes per second.

A code has 50 parts: the wall's distance at each of 32 azimuths, the opening classes of each of 16 pairs of azimuths,
the ceiling, and the room type.

In faiss, a table entry is the inner product of a part of the query vector with a centroid. The centroids here are the
unit vectors, so the query vector is the (negated) tables themselves.
"""

from __future__ import annotations

from concurrent.futures import Executor
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import AZIMUTHS

_VALUES = 16
# Boundaries of the 16 values of a distance (m), finest at typical distances in homes.
_EDGES_M = (0.6, 0.85, 1.1, 1.4, 1.7, 2.05, 2.4, 2.8, 3.2, 3.7, 4.4, 5.4, 7.0, 9.5, 15.0)
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.35, 25.0
# Number of samples within the interval of a value; their costs are averaged.
_SAMPLES = 4
# Boundaries for ceilings (m), and the outer ends of the first and the last interval.
_CEILING_EDGES_M = (2.1, 2.2, 2.3, 2.4, 2.5, 2.6, 2.7, 2.8, 2.95, 3.1, 3.3, 3.6, 4.0, 5.0, 7.0)
_MIN_CEILING_M, _MAX_CEILING_M = 2.0, 9.0
# faiss rounds all tables in proportion to their largest entry; a limit on the ceiling's keeps the others precise.
_MAX_CEILING_COST = 0.25
_PARTS = AZIMUTHS + AZIMUTHS // 2 + 2
CODE_BYTES = _PARTS // 2
# Bytes of a code in an inverted list, with its 64-bit number; lists are padded to blocks of 32 codes.
BYTES_PER_CODE = CODE_BYTES + 8
_BLOCK = 32
_CHUNK = 65_536


def product_codes(rows: np.ndarray) -> UInt8[np.ndarray, "n b"]:
    """Return the codes of prototypes (records of type `prototypes.ROW`), two parts to a byte, the first one lower."""
    # Half-precision numbers are quantised by looking up their 16 bits.
    distance, ceiling = _quantiser(np.log(_EDGES_M)), _quantiser(np.array(_CEILING_EDGES_M))
    code = np.empty((len(rows), CODE_BYTES), np.uint8)
    openings = AZIMUTHS // 2
    for begin in range(0, len(rows), _CHUNK):
        part = rows[begin : begin + _CHUNK]
        target = code[begin : begin + _CHUNK]
        value = distance[np.ascontiguousarray(part["log_profile"]).view(np.uint16)]
        target[:, :openings] = value[:, ::2] | value[:, 1::2] << 4
        target[:, openings:-1] = part["openings"]
        room_type = np.minimum(part["room_type"], _VALUES - 1)
        target[:, -1] = ceiling[np.ascontiguousarray(part["ceiling_m"]).view(np.uint16)] | room_type << 4
    return code


class CodeScan:
    """Inverted lists of product codes; a search scans the lists that the caller probes."""

    def __init__(self, code: UInt8[np.ndarray, "n b"], begin: Int[np.ndarray, "w"]) -> None:
        """Build the faiss index.

        `begin` is the begin of each list in `code`, and the end of the last list.
        """
        # Imported late: only large venues need it, and it takes as long as several queries.
        import faiss

        dimensions = _PARTS * _VALUES
        lists = len(begin) - 1
        # The constructor needs a coarse quantiser, but callers choose the lists. The index refers to it, so keep it.
        self._quantiser = faiss.IndexFlatIP(dimensions)
        filled = faiss.IndexIVFPQ(self._quantiser, dimensions, lists, _PARTS, 4, faiss.METRIC_INNER_PRODUCT)
        filled.by_residual, filled.is_trained = False, True
        faiss.copy_array_to_vector(np.tile(np.eye(_VALUES, dtype=np.float32), (_PARTS, 1)).ravel(), filled.pq.centroids)
        number, stored = np.arange(len(code), dtype=np.int64), cast(Any, filled.invlists)
        for list_number in range(lists):
            part = slice(int(begin[list_number]), int(begin[list_number + 1]))
            entries = np.ascontiguousarray(code[part])
            stored.add_entries(list_number, len(entries), faiss.swig_ptr(number[part]), faiss.swig_ptr(entries))
        filled.ntotal = len(code)
        self._index: Any = faiss.IndexIVFPQFastScan(filled, _BLOCK)
        self._index.nprobe = lists
        # The fast-scan index has its own copy of the codes in blocks; drop the original lists to free memory.
        self._index.orig_invlists = None
        self._index.referenced_objects.clear()

    def search(
        self,
        tables: Float[np.ndarray, "q d"],
        lists: Bool[np.ndarray, "q l"],
        count: int,
        helper: Executor | None = None,
    ) -> tuple[Int[np.ndarray, "q m"], Float[np.ndarray, "q m"]]:
        """Return the numbers of the cheapest codes of each of q queries, and their costs.

        Fewer codes than `count` are filled up with the number -1 and infinite costs. `tables` holds a lookup table per
        query, the 16 values of the 50 parts (see `lookup_tables`); `lists` tells whether each list is probed for each
        query. Every second query is searched on a thread of `helper`, if there is one.
        """
        if helper is None or len(tables) < 2:
            return self._search(tables, lists, count)
        # Neighbours are similar, so that both halves probe about as many codes.
        second = helper.submit(self._search, tables[1::2], lists[1::2], count)
        code, cost = (np.empty((len(tables), count), kind) for kind in (np.int64, np.float32))
        code[::2], cost[::2] = self._search(tables[::2], lists[::2], count)
        code[1::2], cost[1::2] = second.result()
        return code, cost

    def _search(
        self, tables: Float[np.ndarray, "q d"], lists: Bool[np.ndarray, "q l"], count: int
    ) -> tuple[Int[np.ndarray, "q m"], Float[np.ndarray, "q m"]]:
        import faiss

        # Queries of several callers run on threads of their own; by default faiss takes all cores for each.
        faiss.omp_set_num_threads(1)
        number = np.where(lists, np.arange(lists.shape[1]), -1)
        queries = np.ascontiguousarray(-tables, np.float32)
        similarity, code = self._index.search_preassigned(queries, count, number, None)
        return code, np.where(code < 0, np.inf, -similarity)


def lookup_tables(costs: PrototypeCosts, claims: int) -> Float[np.ndarray, "k j p c"]:
    """Return the cost of each value of each part of a code under every heading and height.

    `claims` are the opening classes that the plans claim, as in `prototypes.ROW`.
    """
    (k, j), azimuth = costs.shape, np.arange(AZIMUTHS)
    tables = np.zeros((k, j, _PARTS, _VALUES), np.float32)
    distance = _samples(np.log((_MIN_DISTANCE_M, *_EDGES_M, _MAX_DISTANCE_M)))
    residual = (distance - costs.shifted[..., None, None]) * costs.precision[:, None, :, None, None]
    tables[:, :, azimuth] = np.log1p(np.square(residual)).mean(axis=-1) / AZIMUTHS
    if costs.compares_openings:
        # A value combines the classes of two azimuths, the first in the lower bits.
        loss, classes = costs.opening_loss(claims), len(OPENING_CLASSES)
        pair = loss[:, 1::2, :, None] + loss[:, ::2, None, :]
        tables[:, :, AZIMUTHS:-2] = pair.reshape(k, 1, AZIMUTHS // 2, classes * classes)
    ceiling_m = _samples(np.array((_MIN_CEILING_M, *_CEILING_EDGES_M, _MAX_CEILING_M))).mean(axis=-1)
    tables[:, :, -2] = np.minimum(costs.ceilings(ceiling_m), _MAX_CEILING_COST) + costs.penalty[:, None]
    tables[:, :, -1] = costs.room_types
    return tables


def _quantiser(edges: Float[np.ndarray, "e"]) -> UInt8[np.ndarray, "65536"]:
    """Return the value of every half-precision number, indexed by its 16 bits."""
    with np.errstate(invalid="ignore"):
        number = np.nan_to_num(np.arange(2**16, dtype=np.uint16).view(np.float16).astype(np.float64))
    return np.searchsorted(edges, number, side="right").astype(np.uint8)


def _samples(edges: Float[np.ndarray, "17"]) -> Float[np.ndarray, "16 s"]:
    """Return evenly spaced samples of the interval of each value."""
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return (edges[:-1, None] + np.diff(edges)[:, None] * share).astype(np.float32)
