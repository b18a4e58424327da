"""Prototypes as codes of 25 bytes, which a processor compares with a panorama at more than half a billion a second.

What a prototype costs is a sum over its azimuths, its ceiling and its room type, so that with few values for each, it
is a sum of entries of tables that a query makes once: an asymmetric distance of product quantisation (Jégou et al.,
*Product quantization for nearest neighbor search*, 2011). With 16 values a table fits a register of the processor
(André et al., *Cache locality is not enough*, 2015), for which faiss has the code. It adds up inner products of a query
with centroids: where the centroids are the unit vectors, those are the entries of any tables.

A code has 50 values of four bits: the distance of the wall at each of 32 azimuths, the openings at every two of these,
the ceiling, and the type of the room. Codes choose the prototypes that are then compared exactly.
"""

from __future__ import annotations

from typing import Any, cast

import faiss
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import AZIMUTHS

_VALUES = 16
# Where one value of a distance (m) ends and the next one begins: finest where rooms of homes end.
_EDGES_M = (0.6, 0.85, 1.1, 1.4, 1.7, 2.05, 2.4, 2.8, 3.2, 3.7, 4.4, 5.4, 7.0, 9.5, 15.0)
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.35, 25.0
# Distances within one value whose costs are averaged.
_WITHIN = 4
# The same of ceilings (m), with what is taken for those below and above all of them.
_CEILING_EDGES_M = (2.1, 2.2, 2.3, 2.4, 2.5, 2.6, 2.7, 2.8, 2.95, 3.1, 3.3, 3.6, 4.0, 5.0, 7.0)
_MIN_CEILING_M, _MAX_CEILING_M = 2.0, 9.0
# Tables are rounded in proportion to the largest: what the ceiling alone can say against a prototype is bounded.
_MAX_CEILING_COST = 0.25
_PARTS = AZIMUTHS + AZIMUTHS // 2 + 2
CODE_BYTES = _PARTS // 2
# What a list holds for each code, with its number; in blocks of 32, of which the last one may be half empty.
BYTES_OF_ONE = CODE_BYTES + 8
_BLOCK = 32
_CHUNK = 65_536


def codes_of(rows: np.ndarray) -> UInt8[np.ndarray, "n b"]:
    """Return the codes of prototypes (of `prototypes.ROW`), two values to a byte, the first one lower."""
    distance, ceiling = _value_of(np.log(_EDGES_M)), _value_of(np.array(_CEILING_EDGES_M))
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
    """Codes in lists, and the search of some of these for those that fit a query best."""

    def __init__(self, code: UInt8[np.ndarray, "n b"], first: Int[np.ndarray, "w"]) -> None:
        """Build the index.

        Args:
            code: codes, list by list.
            first: begin of each list in `code`, and the end of the last.
        """
        dimensions = _PARTS * _VALUES
        lists = len(first) - 1
        # Callers choose the lists, not their centres. The index points to this object, so keep it.
        self._unused = faiss.IndexFlatIP(dimensions)
        filled = faiss.IndexIVFPQ(self._unused, dimensions, lists, _PARTS, 4, faiss.METRIC_INNER_PRODUCT)
        filled.by_residual, filled.is_trained = False, True
        faiss.copy_array_to_vector(np.tile(np.eye(_VALUES, dtype=np.float32), (_PARTS, 1)).ravel(), filled.pq.centroids)
        number, stored = np.arange(len(code), dtype=np.int64), cast(Any, filled.invlists)
        for place in range(lists):
            part = slice(int(first[place]), int(first[place + 1]))
            own = np.ascontiguousarray(code[part])
            stored.add_entries(place, len(own), faiss.swig_ptr(number[part]), faiss.swig_ptr(own))
        filled.ntotal = len(code)
        self._index: Any = faiss.IndexIVFPQFastScan(filled, _BLOCK)
        self._index.nprobe = lists
        # It has the codes in another order, and needs no others.
        self._index.orig_invlists = None
        self._index.referenced_objects.clear()

    def best(
        self, tables: Float[np.ndarray, "q d"], lists: Bool[np.ndarray, "q l"], count: int
    ) -> tuple[Int[np.ndarray, "q m"], Float[np.ndarray, "q m"]]:
        """Return the codes of some lists that cost least by tables, and what they cost; -1 where there are not so many.

        Args:
            tables: of the parts of a code (50), the 16 values of each, see `tables_of`.
            lists: which are searched for each of the tables.
            count: how many codes are wanted for each of the tables.
        """
        # The thread is a query's; faiss would take all cores.
        faiss.omp_set_num_threads(1)
        number = np.where(lists, np.arange(lists.shape[1]), -1)
        queries = np.ascontiguousarray(-tables, np.float32)
        similarity, found = self._index.search_preassigned(queries, count, number, None)
        return found, np.where(found < 0, np.inf, -similarity)


def tables_of(costs: PrototypeCosts, claims: int) -> Float[np.ndarray, "k j p c"]:
    """Return the cost of each value of a code under every heading and height, for plans of some claims."""
    (k, j), azimuth = costs.shape, np.arange(AZIMUTHS)
    tables = np.zeros((k, j, _PARTS, _VALUES), np.float32)
    distance = _within(np.log((_MIN_DISTANCE_M, *_EDGES_M, _MAX_DISTANCE_M)))
    centre = costs.centre[:, None] + costs.offsets[None, :, None].astype(np.float32)
    residual = (distance - centre[..., None, None]) * costs.precision[:, None, :, None, None]
    tables[:, :, azimuth] = np.log1p(np.square(residual)).mean(axis=-1) / AZIMUTHS
    if costs.opening_loss is not None:
        # Two azimuths, of which the first one has the lower bits.
        loss, classes = costs.opening_loss[claims], len(OPENING_CLASSES)
        pair = loss[:, 1::2, :, None] + loss[:, ::2, None, :]
        tables[:, :, AZIMUTHS:-2] = pair.reshape(k, 1, AZIMUTHS // 2, classes * classes)
    ceiling_m = _within(np.array((_MIN_CEILING_M, *_CEILING_EDGES_M, _MAX_CEILING_M))).mean(axis=-1)
    tables[:, :, -2] = np.minimum(costs.of_ceilings(ceiling_m), _MAX_CEILING_COST) + costs.penalty[:, None]
    tables[:, :, -1] = costs.of_room_types
    return tables


def _value_of(edges: Float[np.ndarray, "e"]) -> UInt8[np.ndarray, "65536"]:
    """Which value each number of 16 bits has."""
    with np.errstate(invalid="ignore"):
        number = np.nan_to_num(np.arange(2**16, dtype=np.uint16).view(np.float16).astype(np.float64))
    return np.searchsorted(edges, number, side="right").astype(np.uint8)


def _within(edges: Float[np.ndarray, "17"]) -> Float[np.ndarray, "16 s"]:
    """Return some numbers between each two edges."""
    share = (np.arange(_WITHIN) + 0.5) / _WITHIN
    return (edges[:-1, None] + np.diff(edges)[:, None] * share).astype(np.float32)
