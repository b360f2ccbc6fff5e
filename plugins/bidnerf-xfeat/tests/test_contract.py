from __future__ import annotations

from bidnerf_core.testing import FeaturesContract


class TestXFeat(FeaturesContract):
    name = "xfeat"


class TestBoth(FeaturesContract):
    name = "sift-xfeat"
