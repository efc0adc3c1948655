"""Training of models from recipes, and distillation of models."""
