"""Files that controllers keep of their own calibration: writers, and readers that give the robot back."""
