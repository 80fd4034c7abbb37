"""COLMAP's files: models through pycolmap, databases through sqlite3. The one door to both.

Nothing here writes to a model or a database that the user owns. Import the modules themselves:
`check` and `model` read models, `database` reads matches, `matches` holds the values they return.
"""
