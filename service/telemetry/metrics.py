"""Prometheus metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.capacity.cpu_accounts import CpuAccounts
from service.telemetry.tracing import Tracing

_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
_GRID_SECONDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0)


@dataclass(frozen=True, eq=False)
class _PerTenant(Collector):
    """Metric with a value per tenant."""

    family: type[CounterMetricFamily | GaugeMetricFamily]
    name: str
    meaning: str
    read: Callable[[], Mapping[str, float]]

    def collect(self) -> Iterator[Metric]:
        family = self.family(self.name, self.meaning, labels=["tenant"])
        for tenant, value in self.read().items():
            family.add_metric([tenant], value)
        yield family


class Telemetry:
    """Prometheus metrics of one app, in a registry of their own.

    Labels come from small sets, such as route templates, stages, problem kinds and the tenants that the operator
    creates, and never from client input.

    Attributes:
        tracing: exporter of spans; None without an endpoint.
        cpu_accounts: CPU time of each client.
    """

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.tracing: Tracing | None = None
        self.cpu_accounts = CpuAccounts()
        self._gauges: dict[str, Gauge] = {}
        self._counters: dict[str, Counter] = {}
        self._collectors: dict[str, Collector] = {}
        ProcessCollector(registry=self.registry)
        self.requests = self.counter("lalaloc_http_requests", "Answered requests.", ["method", "route", "status"])
        self.request_seconds = self._histogram(
            "lalaloc_http_request_seconds", "Duration of requests, including the upload.", ["route"]
        )
        self.rejections = self.counter("lalaloc_rejections", "Refused requests, by problem kind.", ["reason"])
        self.disconnects = self.counter(
            "lalaloc_disconnects", "Requests whose client disconnected before the end of the answer.", ["route"]
        )
        self.stage_seconds = self._histogram("lalaloc_stage_seconds", "Duration of each stage of a query.", ["stage"])
        self.answers = self.counter("lalaloc_localise_answers", "Answered queries, by last stage.", ["stage"])
        self.lpo_missed = self.counter(
            "lalaloc_lpo_missed", "LPO jobs without a result in time, by reason.", ["reason"]
        )
        self.pool_restarts = self.counter("lalaloc_pool_restarts", "Replaced worker processes, by pool.", ["pool"])
        # Exported as 0 from the start, so that the first restart shows as an increase.
        for pool in ("lpo", "decode", "import", "prediction"):
            self.pool_restarts.labels(pool)
        self.stored_bytes = self._gauge(
            "lalaloc_stored_bytes", "Stored bytes of a tenant, by kind.", ("tenant", "kind")
        )
        self.stored_bytes_limit = self._gauge(
            "lalaloc_stored_bytes_limit", "Limit of the stored bytes of a tenant.", ("tenant",)
        )
        self.grid_cache_hits = self.counter("lalaloc_grid_cache_hits", "Pose grids found in memory.")
        self.grid_cache_misses = self.counter("lalaloc_grid_cache_misses", "Pose grids not found in memory.")
        self.grid_cache_evictions = self.counter("lalaloc_grid_cache_evictions", "Pose grids evicted from memory.")
        self.grid_seconds = self._histogram(
            "lalaloc_grid_seconds", "Duration of the computation of a pose grid.", buckets=_GRID_SECONDS
        )
        self.album_seconds = self._histogram(
            "lalaloc_album_seconds", "Duration of the solution of an album.", buckets=_GRID_SECONDS
        )

    def observe_answer(self, timings_ms: Mapping[str, float], stage: str) -> None:
        """Count an answer that ends at a stage, with the durations (ms) of all stages."""
        for name, spent_ms in timings_ms.items():
            self.stage_seconds.labels(name).observe(spent_ms / 1e3)
        self.answers.labels(stage).inc()

    def counter(self, name: str, meaning: str, labels: Sequence[str] = ()) -> Counter:
        """Add a counter; a restarted app continues with the existing one."""
        if name not in self._counters:
            self._counters[name] = Counter(name, meaning, labels, registry=self.registry)
        return self._counters[name]

    def gauge(self, name: str, meaning: str, read: Callable[[], float]) -> None:
        """Add a gauge that is read on each scrape; a restarted app replaces it."""
        self._gauge(name, meaning).set_function(read)

    def tenant_counter(self, name: str, meaning: str, read: Callable[[], Mapping[str, float]]) -> None:
        """Add a counter per tenant that is read on each scrape; a restarted app replaces it."""
        self._add_per_tenant(_PerTenant(CounterMetricFamily, name, meaning, read))

    def tenant_gauge(self, name: str, meaning: str, read: Callable[[], Mapping[str, float]]) -> None:
        """Add a gauge per tenant that is read on each scrape; a restarted app replaces it."""
        self._add_per_tenant(_PerTenant(GaugeMetricFamily, name, meaning, read))

    def describe_build(self, version: str, model: str, model_version: str, model_sha256: str) -> None:
        """Set the info gauge with the versions of software and model."""
        labels = ("version", "model", "model_version", "sha256")
        gauge = self._gauge("lalaloc_build_info", "Versions of software and model.", labels)
        gauge.clear()
        gauge.labels(version, model, model_version, model_sha256).set(1.0)

    def render(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        return generate_latest(self.registry)

    def _add_per_tenant(self, collector: _PerTenant) -> None:
        if (before := self._collectors.get(collector.name)) is not None:
            self.registry.unregister(before)
        self._collectors[collector.name] = collector
        self.registry.register(collector)

    def _histogram(
        self, name: str, meaning: str, labels: Sequence[str] = (), buckets: Sequence[float] = _SECONDS
    ) -> Histogram:
        return Histogram(name, meaning, labels, buckets=buckets, registry=self.registry)

    def _gauge(self, name: str, meaning: str, labels: Sequence[str] = ()) -> Gauge:
        if name not in self._gauges:
            self._gauges[name] = Gauge(name, meaning, labels, registry=self.registry)
        return self._gauges[name]
