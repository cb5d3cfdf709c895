"""Detect: scores, thresholds, labels and regions. It says what differs, not what to do about it."""
