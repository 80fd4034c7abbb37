"""What a solution looks like: a drawing as plain arrays, drawn as a page, as meshes, and in a live viewer."""
