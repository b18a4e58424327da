"""Photographs that stay on this device: only their features are sent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lalaloc_client.asynchronous.backend import Fetch, Lock, run_blocking
from lalaloc_client.on_device import Film, OnDeviceModel, TurnFeatures
from lalaloc_client.requests import Photograph


class AsyncDevice:
    """Encodes photographs with the model of a service, which is loaded at the first one."""

    def __init__(self, fetch: Fetch) -> None:
        """Remember how to get a file of the service, by its path."""
        self._fetch = fetch
        self._model: OnDeviceModel | None = None
        self._lock = Lock()

    def forget(self) -> None:
        """Load the model anew for the next photograph, because the service has another one."""
        self._model = None

    async def features(self, photographs: Sequence[Photograph], options: Mapping[str, Any]) -> list[bytes]:
        """Return the features of photographs, given options about their camera."""
        model = await self._current()
        return [await run_blocking(model.features, photograph, options) for photograph in photographs]

    async def turn(self, turn: Film | Sequence[Photograph], options: Mapping[str, Any]) -> TurnFeatures:
        """Return the features of a turn, and its angles, given options about its camera."""
        model = await self._current()
        return await run_blocking(model.turn, turn, options)

    async def _current(self) -> OnDeviceModel:
        async with self._lock:
            if self._model is None:
                self._model = await self._loaded()
            return self._model

    async def _loaded(self) -> OnDeviceModel:
        model = await run_blocking(OnDeviceModel, await self._fetch("/model/manifest.json"))
        for name in await run_blocking(model.missing):
            await run_blocking(model.store, name, await self._fetch(f"/model/{name}"))
        await run_blocking(model.load)
        return model
