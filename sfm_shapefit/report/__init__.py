"""What a solution looks like: a drawing as plain arrays, drawn as a page and as a mesh."""
