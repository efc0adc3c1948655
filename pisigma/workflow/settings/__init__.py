"""What steps are asked for: settings, which are read without torch so that command lines begin at once."""
