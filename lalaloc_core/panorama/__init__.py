"""Panoramas as files: decoding any picture, completing and levelling the sphere by its metadata.

Begin with `images.py`.
"""
