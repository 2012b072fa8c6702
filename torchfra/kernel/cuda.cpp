// One thread for each track.
struct Ports { Port in[INPUTS], out[OUTPUTS]; };
extern "C" __global__ void run(int64_t tracks, int64_t steps, const __grid_constant__ Ports ports) {
  const int64_t track = blockIdx.x * (int64_t)blockDim.x + threadIdx.x;
  if (track < tracks) step::block(ports.in, ports.out, steps, Block{track, 1, 0});
}
