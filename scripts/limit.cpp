// The SRCKF of scripts/benchmark.py's job written by hand, to compare with: W tracks side by side, last means only.
//   g++ -O3 -march=native -ffast-math -fopenmp limit.cpp -o limit && ./limit 10000
// Prints a JSON line with the seconds of the first call, then one with those of a call for each line that it reads.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <omp.h>
#include <vector>
constexpr int W = 8, N = 6, T = 100;
typedef double V __attribute__((vector_size(W * 8)));
static inline V all(double a) { V v; for (int i = 0; i < W; i++) v[i] = a; return v; }
static inline V root(V a) { V r; for (int i = 0; i < W; i++) r[i] = std::sqrt(a[i]); return r; }
static inline V atan2v(V a, V b) { V r; for (int i = 0; i < W; i++) r[i] = std::atan2(a[i], b[i]); return r; }
static inline V wrap(V a) { V r; for (int i = 0; i < W; i++) r[i] = a[i] - 2 * M_PI * std::floor((a[i] + M_PI) / (2 * M_PI)); return r; }

// Lower-triangular L with L L^T = A A^T, by Householder reflections.
template <int n, int p> static inline void tria(V (&A)[n][p], V (&L)[n][n]) {
  for (int j = 0; j < n; j++) {
    V s = all(0);
    for (int k = j; k < p; k++) s += A[j][k] * A[j][k];
    V norm = root(s), sign;
    for (int i = 0; i < W; i++) sign[i] = A[j][j][i] >= 0 ? 1 : -1;
    V head = A[j][j] + sign * norm, scale = 2.0 / (s - A[j][j] * A[j][j] + head * head);
    A[j][j] = head;
    L[j][j] = norm;
    for (int i = j + 1; i < n; i++) {
      V d = all(0);
      for (int k = j; k < p; k++) d += A[i][k] * A[j][k];
      d *= scale;
      for (int k = j; k < p; k++) A[i][k] -= d * A[j][k];
      L[i][j] = -sign * A[i][j];
      L[j][i] = all(0);
    }
  }
}

int main(int argc, char **argv) {
  const int runs = argc > 1 ? atoi(argv[1]) : 10000, blocks = (runs + W - 1) / W;
  const double q = 1e-2, sigma = M_PI / 180, dt = 1, c = 1 / std::sqrt(2.), v = 100 / std::sqrt(2.), st[4] = {0, 0, 2000, 0};
  const double x0[N] = {2010, 4010, 6, -10, .2, -.3}, s0[N] = {10, 10, 1, 1, .1, .1}, g[3] = {dt * dt / 2, dt, 1};
  std::vector<V> z(size_t(blocks) * T * 2), out(size_t(blocks) * N);
  for (int b = 0; b < blocks; b++)
    for (int t = 0; t < T; t++)
      for (int s = 0; s < 2; s++) {
        double k = t + 1, px = 2000 + 6 * k + .1 * k * k, py = 4000 - 10 * k - .15 * k * k;
        for (int i = 0; i < W; i++)
          z[(size_t(b) * T + t) * 2 + s][i] = std::atan2(px - st[2 * s] - v * k, py - st[2 * s + 1] - v * k) + sigma * std::sin(12.9898 * (b * W + i) + 78.233 * t + s);
      }
  auto call = [&] {
    auto t0 = std::chrono::steady_clock::now();
#pragma omp parallel for schedule(static)
    for (int b = 0; b < blocks; b++) {
      V x[N], S[N][N];
      for (int i = 0; i < N; i++) { x[i] = all(x0[i]); for (int j = 0; j < N; j++) S[i][j] = all(i == j ? s0[i] : 0); }
      for (int t = 0; t < T; t++) {
        V xp[N], A[N][N + 2], Sp[N][N];
        for (int i = 0; i < N; i++) {
          xp[i] = x[i];
          if (i < 4) xp[i] += dt * x[i + 2];
          if (i < 2) xp[i] += dt * dt / 2 * x[i + 4];
          for (int j = 0; j < N; j++) {
            V a = S[i][j];
            if (i < 4) a += dt * S[i + 2][j];
            if (i < 2) a += dt * dt / 2 * S[i + 4][j];
            A[i][j] = a;
          }
          for (int j = 0; j < 2; j++) A[i][N + j] = all(i % 2 == j ? std::sqrt(q) * g[i / 2] : 0);
        }
        tria<N, N + 2>(A, Sp);
        V Z[2][12], zh[2], e[2], MZ[2][14], L[2][2];
        for (int s = 0; s < 2; s++) {
          V ref, mean = all(0);
          for (int k = 0; k < 12; k++) {
            double r = (k < 6 ? 1 : -1) * std::sqrt(6.);
            V a = atan2v(xp[0] + r * Sp[0][k % 6] - (st[2 * s] + v * (t + 1)), xp[1] + r * Sp[1][k % 6] - (st[2 * s + 1] + v * (t + 1)));
            if (!k) ref = a;
            mean += Z[s][k] = wrap(a - ref);
          }
          mean /= 12;
          zh[s] = ref + mean;
          e[s] = wrap(z[(size_t(b) * T + t) * 2 + s] - zh[s]);
          for (int k = 0; k < 12; k++) MZ[s][k] = Z[s][k] = (Z[s][k] - mean) / std::sqrt(12.);
          for (int k = 0; k < 2; k++) MZ[s][12 + k] = all(s == k ? sigma : 0);
        }
        tria<2, 14>(MZ, L);
        V K[N][2], M[N][14];
        for (int i = 0; i < N; i++) {
          V p[2] = {all(0), all(0)};
          for (int s = 0; s < 2; s++) for (int j = 0; j <= i; j++) p[s] += c * Sp[i][j] * (Z[s][j] - Z[s][j + 6]);
          V y0 = p[0] / L[0][0], y1 = (p[1] - L[1][0] * y0) / L[1][1];
          K[i][1] = y1 / L[1][1];
          K[i][0] = (y0 - L[1][0] * K[i][1]) / L[0][0];
          x[i] = xp[i] + K[i][0] * e[0] + K[i][1] * e[1];
          for (int k = 0; k < 12; k++) {
            M[i][k] = -(K[i][0] * Z[0][k] + K[i][1] * Z[1][k]);
            if (k % 6 <= i) M[i][k] += (k < 6 ? c : -c) * Sp[i][k % 6];
          }
          for (int k = 0; k < 2; k++) M[i][12 + k] = K[i][k] * sigma;
        }
        tria<N, 14>(M, S);
      }
      for (int i = 0; i < N; i++) out[size_t(b) * N + i] = x[i];
    }
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - t0).count();
  };
  printf("{\"first_call_s\": %.6f, \"threads\": %d}\n", call(), omp_get_max_threads());
  fflush(stdout);
  call();
  for (int c; (c = getchar()) != EOF;) {
    if (c != '\n') continue;
    std::vector<double> seconds;
    for (double sum = 0; sum < 0.02; sum += seconds.back()) seconds.push_back(call());
    std::nth_element(seconds.begin(), seconds.begin() + seconds.size() / 2, seconds.end());
    printf("{\"seconds\": %.9f}\n", seconds[seconds.size() / 2]);
    fflush(stdout);
  }
  double sum = 0;
  for (auto &o : out) sum += o[0];
  fprintf(stderr, std::isfinite(sum) ? "" : "NaN or infinity\n");  // and the compiler may leave nothing out
}
