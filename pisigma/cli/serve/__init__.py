"""Commands that serve until they are ended: `pisigma serve`, and `pisigma open`."""
