"""Programs in JavaScript, C++ and Rust that test themselves against the vectors of the wire format."""
