"""What is made of a finished dataset: card, exports, pictures, views."""
