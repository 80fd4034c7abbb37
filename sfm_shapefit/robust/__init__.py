"""What the answer is worth: verdicts on pairs, uncertainty and trust of cameras."""
