// One thread for each track.  At least BLOCKS blocks fit into a multiprocessor: 8 leave each thread all the registers it
// can have; 16 let more threads wait, where some of a block wait for others anyway.
struct Ports { Port in[INPUTS], out[OUTPUTS]; };
extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS)
run(int64_t tracks, int64_t steps, const __grid_constant__ Ports ports) {
  const int64_t track = blockIdx.x * (int64_t)blockDim.x + threadIdx.x;
  if (track < tracks) step::block(ports.in, ports.out, steps, track);
}
