"""What `locate`, `map` and `place` return, and its files."""
