"""ROS: bags as bidnerf sequences, and a ROS 2 node that publishes the poses it finds."""
