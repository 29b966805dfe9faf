"""Training of networks that complete drawings."""
