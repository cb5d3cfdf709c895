"""Observe: from an aligned scan to what it says of the part: deviations, rays, what is background.

It measures along rays and normals; it sums nothing up and judges nothing.
"""
