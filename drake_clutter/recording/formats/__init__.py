"""Writers of recorded episodes in the formats of other programs."""
