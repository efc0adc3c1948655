"""What sensors measure: residuals and their derivatives, one file a sensor."""
