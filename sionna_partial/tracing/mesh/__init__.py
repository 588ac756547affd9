"""Path candidates of meshes."""
