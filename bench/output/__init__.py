"""What a command leaves: files, bars, intervals as pictures."""
