"""What navigation measures beside the readings."""
