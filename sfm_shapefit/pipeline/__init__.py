"""The stages of the commands: measure, place, adjust, judge, seed, set the gauge, ask for evidence."""
