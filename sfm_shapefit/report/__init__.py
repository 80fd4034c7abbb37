"""What a solution looks like: the scene as plain arrays, drawn as a page, as meshes, and in a live viewer."""
