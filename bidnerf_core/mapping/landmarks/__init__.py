"""The landmarks of a map: points with descriptors, triangulated from its images."""
