"""What a network that learned to fill in drawings says of the shape, beside what code and pose say."""
