"""nerfstudio's trained runs as maps: nerfacto, instant-ngp and vanilla-nerf, reimplemented in PyTorch."""
