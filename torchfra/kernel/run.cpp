extern "C" void run(int64_t tracks, int64_t steps, int threads, const Port* in, const Port* out) {
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t first = 0; first < tracks; first += W)
    block(in, out, steps, Block{first, tracks - first < W ? tracks - first : W, 0});
}
