"""Tracking: poses of the frames of a sequence, each predicted from the preceding frames."""
