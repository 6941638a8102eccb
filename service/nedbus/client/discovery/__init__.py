"""What is known of others: who publishes, which services there are, which layouts they know, what they reject."""
