"""`map`: from a database alone to placed cameras; rotations are averaged first."""
