extern "C" void run(int64_t tracks, int64_t steps, int threads, const Port* in, const Port* out) {
  const int64_t share = (tracks + W * threads - 1) / (W * threads), packs = share < step::PACKS ? share : step::PACKS;
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t first = 0; first < tracks; first += W * packs)
    step::block(in, out, steps, Block{first, tracks - first < W * packs ? tracks - first : W * packs, 0});
}
