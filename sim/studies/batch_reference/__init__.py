"""The batch MAP over all raw measurements: the accuracy that no team can exceed."""
