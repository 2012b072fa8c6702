// A loop over time for blocks of tracks that lie side by side in vector registers.
// torchfra.kernel.source replaces FUNCTIONS, SCALAR, TIME, FIXED, STEP and END.
