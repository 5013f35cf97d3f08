"""A weights-free geometry model: features, small bundle adjustment, plane sweep."""
