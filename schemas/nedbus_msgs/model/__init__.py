"""The definition of a message: fields and types, layouts, rules, validation; made from its file in `messages/`."""
