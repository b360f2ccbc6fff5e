"""Examples of what bidnerf takes from others by name: a reader, a method, a detector of keypoints and a fault."""
