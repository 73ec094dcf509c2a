# A mapping alone: sets, dimensions and sums (report, Figure 3).
input x1[I], x2[10], x3[2, 2, 3], x4[3, 4];
output y1[I], y2[I], y3[J, J, K], y4[K], y5, y6[I];
parameter d[I] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1];
set I = |0:9|;
set J = |0:1|;
set K = |0:2|;
set L = |0:3|;
real v[I];
y1[i] = x1[i] + x2[i] foreach i in I;
y2[i] = x1[i]*x2[i] foreach i in I;
y3[i, j, k] = 2*x3[i, j, k] foreach i in J, j in J, k in K;
y4[k] = sum(l in L | x4[k, l]) foreach k in K;
y5 = sum(k in K | y4[k]*sum(i in J | sum(j in J | y3[i, j, k])));
v[i] = (d[i] - x1[i])^2 foreach i in I;
y6[i] = v[i] foreach i in I;
