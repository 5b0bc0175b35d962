"""How good the pictures are, measured as the literature does."""
