"""The application: `serve run service.on_ray:app`, or with other numbers, `... search_max=16 lpo_max=32`."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ray import serve
from ray.serve.config import AutoscalingConfig, RequestRouterConfig
from ray.serve.experimental.consistent_hash_router import ConsistentHashRouter

from lalaloc_core.errors import ConfigError
from lalaloc_core.localise.bundle import Bundle
from service.fair_share import with_headroom
from service.on_ray.replicas import EncoderReplica, IngressReplica, LpoReplica, SearchReplica
from service.settings import Settings

Replicas = Annotated[int, Field(ge=1, le=1000)]

# Of a replica that searches: while one query waits for encoder or optimiser, another is searched for.
_SEARCH_THREADS = 2
# What may be under way in a replica besides what it works on: the next one, so that it has no pause.
_NEXT = 1


class RayOptions(BaseModel):
    """How many replicas there are of each deployment, at least and at most."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ingress_min: Replicas = 1
    ingress_max: Replicas = 4
    encoder_min: Replicas = 1
    encoder_max: Replicas = 8
    search_min: Replicas = 1
    search_max: Replicas = 8
    lpo_min: Replicas = 1
    lpo_max: Replicas = 16


def app(arguments: dict[str, str]) -> serve.Application:
    """The application, of the settings in the environment.

    Args:
        arguments: those of `serve run`, by name: see `RayOptions`.

    Raises:
        ConfigError: a setting or an argument is wrong, or fewer replicas are allowed than there must be.
        BundleError: there is no usable model.
    """
    try:
        options = RayOptions.model_validate(arguments)
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, one['loc']))} is {one['input']!r}: {one['msg']}" for one in error.errors()]
        raise ConfigError(f"{'; '.join(faults)}; known are {', '.join(RayOptions.model_fields)}") from error
    return application(Settings.load(), options)


def application(settings: Settings, options: RayOptions) -> serve.Application:
    """See `app`; every replica gets the settings, so what they name, such as the bundle, has to be on every machine."""
    sha256 = Bundle.open(settings.bundle).sha256
    threads = settings.compute.onnx_threads or 1
    of_search = settings.with_values(workers=0, compute_threads=_SEARCH_THREADS, onnx_threads=threads)
    per_search = of_search.query_limit + of_search.requests.max_waiting_queries
    # As many as all replicas that there may be take: else there would never be more of them.
    most = settings.requests.max_queries or with_headroom(options.search_max * of_search.query_limit)
    # Panoramas are decoded where they are searched for.
    of_ingress = settings.with_values(workers=0, decode_workers=1, max_queries=most)
    single = settings.with_values(onnx_threads=threads)

    encoder = serve.deployment(
        EncoderReplica,
        name="encoder",
        max_ongoing_requests=1 + _NEXT,
        **_scaled("encoder", options, target=1.0 + _NEXT),
    ).bind(single, sha256)
    lpo = serve.deployment(
        LpoReplica,
        name="lpo",
        max_ongoing_requests=1 + _NEXT,
        max_queued_requests=settings.lpo.queue,
        **_scaled("lpo", options, target=1.0 + _NEXT),
    ).bind(single, sha256)
    # As without Ray, no workers are no LPO; any other number is a matter of replicas.
    optimiser = None if settings.compute.workers == 0 else lpo
    # The class is annotated as what it is not.
    routed: dict[str, Any] = {"request_router_class": ConsistentHashRouter}
    search = serve.deployment(
        SearchReplica,
        name="search",
        max_ongoing_requests=per_search,
        request_router_config=RequestRouterConfig(**routed),
        graceful_shutdown_timeout_s=settings.requests.stop_deadline_s,
        **_scaled("search", options, target=float(of_search.query_limit)),
    ).bind(of_search, sha256, encoder, optimiser)
    ingress = serve.deployment(
        IngressReplica,
        name="ingress",
        max_ongoing_requests=of_ingress.pending_limit + settings.requests.max_reads + settings.requests.max_streams,
        graceful_shutdown_timeout_s=settings.requests.stop_deadline_s,
        **_scaled("ingress", options, target=0.5 * of_ingress.pending_limit),
    )
    return ingress.bind(of_ingress, optimiser, search)


def _scaled(name: str, options: RayOptions, target: float) -> dict[str, Any]:
    """How many replicas a deployment has.

    Args:
        target: requests under way in each of them that there should be on average.

    Raises:
        ConfigError: the most is less than the least.
    """
    least, most = getattr(options, f"{name}_min"), getattr(options, f"{name}_max")
    if most < least:
        raise ConfigError(f"{name}_max is {most}, less than {name}_min, which is {least}")
    if least == most:
        return {"num_replicas": least}
    scaling = AutoscalingConfig(min_replicas=least, max_replicas=most, target_ongoing_requests=target)
    return {"autoscaling_config": scaling}
