// What this machine can do at most: fused multiply-adds, and memory.  SCALAR is the type of numbers, BYTES the size of registers.
#include <cstdint>
#ifdef __AVX__
#include <immintrin.h>
#endif
namespace {
typedef SCALAR V __attribute__((vector_size(BYTES)));
using Scalar = SCALAR;
struct Port { char* data; int64_t track, time, entry; };
// 16 sums at once, as many as hide the time of one.
template <class T> __attribute__((noinline)) T multiply_add(T x, int64_t times) {
  T sums[16];
#pragma GCC unroll 16
  for (int i = 0; i < 16; i++) sums[i] = x + static_cast<Scalar>(i);
  for (int64_t k = 0; k < times; k++)
#pragma GCC unroll 16
    for (int i = 0; i < 16; i++) sums[i] = sums[i] * x + x;
  T total = sums[0];
#pragma GCC unroll 16
  for (int i = 1; i < 16; i++) total += sums[i];
  return total;
}
// A store that does not read the line first.
inline void past_caches(V* to, const V& v) {
#if defined(__AVX512F__)
  _mm512_stream_si512(reinterpret_cast<__m512i*>(to), (__m512i)v);
#elif defined(__AVX__)
  _mm256_stream_si256(reinterpret_cast<__m256i*>(to), (__m256i)v);
#else
  *to = v;
#endif
}
}  // namespace

// steps 0: tracks rounds of 16 fused multiply-adds of vectors.  1: adds one to tracks vectors.  2: the same, past the caches.
extern "C" void run(int64_t tracks, int64_t steps, int threads, const Port* in, const Port* out) {
  V* to = reinterpret_cast<V*>(out->data);
  const V* from = reinterpret_cast<const V*>(in->data);
  if (steps == 0) to[0] = multiply_add(from[0], tracks);
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t i = 0; i < (steps ? tracks : 0); i++) {
    const V v = from[i & 1023] + Scalar(1);
    if (steps == 1) to[i] = v;
    else past_caches(to + i, v);
  }
}
