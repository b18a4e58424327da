"""The service on several machines: a Ray Serve application, `serve run service.on_ray:app`. Needs the extra `ray`.

The ingress is the service as it is, whose queries are answered by others:

    ingress (the HTTP API)  →  search (plans in memory, the search itself)  →  encoder (the network of images)
                                                                            →  lpo (the optimiser, on torch)

Each is a deployment with replicas of its own, more or fewer by what they have to do. The same plan or venue is searched
by the same replica, by consistent hashing, so that its latent grid stays in memory there. Begin with `application.py`;
`replicas.py` is what runs in each deployment, `remote.py` how they ask one another.
"""

from service.on_ray.application import RayOptions, app

__all__ = ["RayOptions", "app"]
