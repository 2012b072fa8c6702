// One thread for each track; those behind the last track compute it once more, as all threads of a block must come to its
// barriers.  At least BLOCKS blocks fit into a multiprocessor: more leave each thread fewer registers, and let more wait.
struct Ports { Port in[INPUTS], out[OUTPUTS]; };
extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS)
run(int64_t tracks, int64_t steps, const __grid_constant__ Ports ports) {
  const int64_t track = blockIdx.x * (int64_t)blockDim.x + threadIdx.x;
  step::block(ports.in, ports.out, steps, track < tracks ? track : tracks - 1);
}
