"""A fit as a textured triangle mesh: depth maps, their surface, its textures, and the files that hold it."""
