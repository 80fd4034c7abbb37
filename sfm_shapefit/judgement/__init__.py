"""What a solution says of its pairs and cameras: verdicts, trust, uncertainty, a second configuration."""
