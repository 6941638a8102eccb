"""The ULog stream over MAVLink: reassembly, the client, and the peer that plays a PX4."""
