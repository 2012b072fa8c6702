#if !defined(PARTS) || PARTS & 1
// THREADS
#ifdef _WIN32
__declspec(dllexport)
#endif
extern "C" void run(int64_t tracks, int64_t steps, int threads, const Port* in, const Port* out) {
  if (tracks == 0) return;
  const int64_t packs = (tracks + W - 1) / W, share = threads * step::PACKS;
  const int64_t blocks = (packs + share - 1) / share * threads;  // of PACKS at most, as many for each thread
  const bool past = tracks * steps * step::WRITTEN * int64_t{sizeof(Scalar)} >= MANY_BYTES;  // of what no cache keeps
  on_threads(threads, [&](int64_t thread) {
    for (int64_t k = blocks / threads * thread; k < blocks / threads * (thread + 1); k++) {
      const int64_t first = packs * k / blocks * W, last = packs * (k + 1) / blocks * W;
      if (first < last) step::block(in, out, steps, Block{first, (last < tracks ? last : tracks) - first, 0, past});
    }
#ifdef PAST_CACHES
    _mm_sfence();  // all is there before the threads meet
#endif
  });
}
#endif
