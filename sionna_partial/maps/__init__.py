"""What has been observed of a building: PartialMap, its files, ROS maps, arrays, and meshes."""
