"""Base, tool and hand-eye as small jobs: with the arm of a robot, model or cell as given."""
