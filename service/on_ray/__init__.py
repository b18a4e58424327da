"""The service on several machines as a Ray Serve application: `serve run service.on_ray:app`. Needs the extra `ray`.

The ingress is the normal service; other deployments compute its queries:

    ingress (the HTTP API)  →  search (plans in memory, the search itself)  →  encoder (the image network)
                                                                            →  lpo (pose refinement, on torch)
                                                                            →  index-0, index-1, … (of venues, optional)

Each deployment scales its replicas by load. Consistent hashing sends queries about a plan or venue to the same search
replica, which keeps its pose grid in memory. Begin with `application.py`; `replicas.py` runs in each deployment,
`remote.py` and `index_shards.py` connect them.
"""

from service.on_ray.application import RayOptions, app
