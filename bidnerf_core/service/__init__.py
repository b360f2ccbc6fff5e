"""The HTTP service: photos in, poses out, from maps that several worker processes share.

The process that listens decodes nothing and does not import torch. It hands each request to a worker, a fork of the one process
that loaded the maps, so that a photo can only ever end its own worker, and memory holds every map once.
"""
