"""Demo: an example flat and photographs in it, localised over HTTP.

Begin with `demo.py`. `launch.py` starts the service.
"""
