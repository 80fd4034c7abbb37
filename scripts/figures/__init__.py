"""What the figure scripts share: batches of small problems, and their results kept between runs."""
