"""The GeoPose Protocol of the Open AR Cloud for the service of bidnerf."""
