"""The demo: an example flat and photographs taken in it, localised over HTTP."""
