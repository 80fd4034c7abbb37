"""The steps that the commands share, between the values of the core and the files of the user."""
