"""Whether a calibrated robot still is as its model says: session after session, and over the months."""
