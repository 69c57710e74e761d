"""How far off an answer may be, and how strange what it was made from."""
