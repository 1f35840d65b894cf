"""From attention maps to drop masks: threshold, dilation and the temporal mean."""
