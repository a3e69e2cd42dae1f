"""Motors: CiA 402 drives over CANopen, the control loop, its safety, its log in the format of recordings; no JAX."""
