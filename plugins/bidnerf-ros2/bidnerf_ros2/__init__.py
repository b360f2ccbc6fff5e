"""ROS: bags as sequences of bidnerf, and a node of ROS 2 that publishes the poses that it finds."""
