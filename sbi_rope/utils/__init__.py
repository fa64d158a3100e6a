"""What every room uses: errors, settings, tensors, seeds, progress, files."""
