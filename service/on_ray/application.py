"""Ray Serve application: `serve run service.on_ray:app`, with options such as `search_max=16 lpo_max=32`."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError
from ray import serve
from ray.serve.config import AutoscalingConfig, RequestRouterConfig
from ray.serve.experimental.consistent_hash_router import ConsistentHashRouter

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import ConfigError
from service.capacity.fair_share import with_headroom
from service.on_ray.replicas import EncoderReplica, IndexReplica, IngressReplica, LpoReplica, SearchReplica
from service.settings import Settings

Replicas = Annotated[int, Field(ge=1, le=1000)]

# Queries per search replica: one computes while the other waits for encoder or LPO.
_SEARCH_THREADS = 2
# Requests queued at a replica besides the running request, so that it never idles.
_QUEUED_REQUESTS = 1
# Searches of a shard at a time.
_INDEX_REQUESTS = 4


class RayOptions(BaseModel, frozen=True, extra="forbid"):
    """Minimum and maximum number of replicas per deployment.

    Attributes:
        index_shards: deployments between which the index of each venue is divided; 0: each search replica has the
            whole index.
    """

    ingress_min: Replicas = 1
    ingress_max: Replicas = 4
    encoder_min: Replicas = 1
    encoder_max: Replicas = 8
    search_min: Replicas = 1
    search_max: Replicas = 8
    lpo_min: Replicas = 1
    lpo_max: Replicas = 16
    index_shards: Annotated[int, Field(ge=0, le=1000)] = 0


def app(arguments: dict[str, str]) -> serve.Application:
    """Build the application from the settings in the environment."""
    try:
        options = RayOptions.model_validate(arguments)
    except ValidationError as error:
        faults = [
            f"{'.'.join(map(str, fault['loc']))} is {fault['input']!r}: {fault['msg']}" for fault in error.errors()
        ]
        raise ConfigError(f"{'; '.join(faults)}; known: {', '.join(RayOptions.model_fields)}") from error
    return application(Settings.load(), options)


def application(settings: Settings, options: RayOptions) -> serve.Application:
    """Build the application; paths in the settings, such as the bundle, must exist on every machine."""
    sha256 = Bundle.open(settings.bundle).sha256
    threads = settings.compute.onnx_threads or 1
    search_settings = settings.with_values(workers=0, compute_threads=_SEARCH_THREADS, onnx_threads=threads)
    per_search = search_settings.query_limit + search_settings.requests.max_waiting_queries
    # The capacity of the maximum number of replicas, so that autoscaling can reach it.
    max_queries = settings.requests.max_queries or with_headroom(options.search_max * search_settings.query_limit)
    # Photographs are decoded in the search replicas.
    ingress_settings = settings.with_values(workers=0, decode_workers=1, max_queries=max_queries)
    single = settings.with_values(onnx_threads=threads)

    encoder = serve.deployment(
        EncoderReplica,
        name="encoder",
        max_ongoing_requests=1 + _QUEUED_REQUESTS,
        **_scaled("encoder", options, target=1.0 + _QUEUED_REQUESTS),
    ).bind(single, sha256)
    lpo = serve.deployment(
        LpoReplica,
        name="lpo",
        max_ongoing_requests=1 + _QUEUED_REQUESTS,
        max_queued_requests=settings.lpo.queue,
        **_scaled("lpo", options, target=1.0 + _QUEUED_REQUESTS),
    ).bind(single, sha256)
    # 0 workers turn LPO off; any other number is replaced by the number of replicas.
    optimiser = None if settings.compute.workers == 0 else lpo
    # The annotation of the router class is wrong.
    routed: dict[str, Any] = {"request_router_class": ConsistentHashRouter}
    index_settings = settings.with_values(workers=0, compute_threads=1, decode_workers=1, onnx_threads=threads)
    shards = [
        serve.deployment(IndexReplica, name=f"index-{number}", max_ongoing_requests=_INDEX_REQUESTS).bind(
            index_settings, sha256, encoder
        )
        for number in range(options.index_shards)
    ]
    search = serve.deployment(
        SearchReplica,
        name="search",
        max_ongoing_requests=per_search,
        request_router_config=RequestRouterConfig(**routed),
        graceful_shutdown_timeout_s=settings.requests.stop_deadline_s,
        **_scaled("search", options, target=float(search_settings.query_limit)),
    ).bind(search_settings, sha256, encoder, optimiser, shards)
    ingress = serve.deployment(
        IngressReplica,
        name="ingress",
        max_ongoing_requests=ingress_settings.pending_limit
        + settings.requests.max_reads
        + settings.requests.max_streams,
        graceful_shutdown_timeout_s=settings.requests.stop_deadline_s,
        **_scaled("ingress", options, target=0.5 * ingress_settings.pending_limit),
    )
    return ingress.bind(ingress_settings, optimiser, search)


def _scaled(name: str, options: RayOptions, target: float) -> dict[str, Any]:
    low, high = getattr(options, f"{name}_min"), getattr(options, f"{name}_max")
    if high < low:
        raise ConfigError(f"{name}_max is {high}, less than {name}_min, which is {low}")
    if low == high:
        return {"num_replicas": low}
    scaling = AutoscalingConfig(min_replicas=low, max_replicas=high, target_ongoing_requests=target)
    return {"autoscaling_config": scaling}
