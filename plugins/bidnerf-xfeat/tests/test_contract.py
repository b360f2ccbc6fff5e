from __future__ import annotations

from bidnerf.testing import FeaturesContract


class TestXFeat(FeaturesContract):
    name = "xfeat"


class TestBoth(FeaturesContract):
    name = "sift-xfeat"
