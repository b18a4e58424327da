"""Parts of this process that answer queries."""

from __future__ import annotations

from dataclasses import dataclass

from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from service.decoding.decoder import Decoder
from service.query.executor import Executor
from service.query.grounds import Grounds
from service.query.photograph_reader import PhotographReader


@dataclass(frozen=True, kw_only=True)
class QueryParts:
    """Parts that single photographs, sequences and sessions share."""

    bundle: Bundle
    encoder: PhotographEncoder
    decoder: Decoder
    reader: PhotographReader
    grounds: Grounds
    executor: Executor
