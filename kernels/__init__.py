"""Warp kernels: what is computed, per thread."""

if __name__ != "warpir.kernels":
    raise ImportError("this folder is the package warpir.kernels; import it by that name")
