"""Task D: stroke volume and ejection time from the pulse at the wrist."""
