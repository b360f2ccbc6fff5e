"""Trained runs of nerfstudio as maps: nerfacto, instant-ngp and vanilla-nerf, rebuilt in PyTorch."""
