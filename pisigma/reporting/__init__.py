"""Results of pisigma as tables, figures, cards of models and HTML pages."""
