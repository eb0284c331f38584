"""Mathematics that knows no scene: frames, lat-long maps, random numbers, spherical Gaussians."""
