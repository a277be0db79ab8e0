"""Scene generators and exploration policies, trained and rule-based, and their training."""
