"""What `ultratight.monte_carlo` is made of: cells, runs, a journal, the Dataset and its table."""
