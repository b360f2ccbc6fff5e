"""Results: errors, trajectories, pose files and overlays."""
