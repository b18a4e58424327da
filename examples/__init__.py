"""The demo: an example flat and photographs taken in it, localised over HTTP.

Begin with `demo.py`; `serve.py` starts the service with the example flat.
"""
