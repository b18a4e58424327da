"""Photograph to query: the exported networks on onnxruntime. Never imports torch.

Begin with `photograph_encoder.py`, which chooses the network: `sphere_encoder.py` for full spheres, `view_encoder.py`
for parts of the horizon. `features.py` has a network's outputs as a file that a device sends instead of the photograph.

Encoders are made of a bundle and the number of intra-op threads of each session, 0 for one per core. They raise
`BundleError` if a file of the bundle is missing or altered, or if its model is not one that they can run.
"""
