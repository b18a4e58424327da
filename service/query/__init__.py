"""What answers a panorama: decoding it, and the search with the optimiser in worker processes.

Begin with `localiser.py`.
"""
