"""The small data sets that come with the package."""
