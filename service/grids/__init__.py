"""Latent grids: found in memory or in the store, computed by one replica for all of them."""
