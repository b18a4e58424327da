"""Demo: an example flat and panoramas in it, localised over HTTP.

Begin with `demo.py`. `serve.py` starts the service with the example flat.
"""
