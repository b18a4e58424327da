"""Demo: an example flat and photographs in it, localised over HTTP.

Begin with `demo.py`. `serve.py` starts the service with the example flat.
"""
