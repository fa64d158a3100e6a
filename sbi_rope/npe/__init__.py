"""A trained NPE of sbi, taken apart, its prior, and its units."""
