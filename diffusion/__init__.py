"""What looks right: diffusion priors and the guidance they give (not built yet)."""

if __name__ != "warpir.diffusion":
    raise ImportError("this folder is the package warpir.diffusion; import it by that name")
