"""Export of trained weights to a model bundle.

Begin with `run_export.py`, which exports a training run; `bundle_export.py` writes ONNX and safetensors files and
compares them with torch.
"""
