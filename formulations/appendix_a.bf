# The beam matrix of a quadrupole scan with known transport (report, Appendix A).
# s11, s12, s22 are in 1e-8 m2, m rad, rad2; sizes in um; columns 9 and 10 of the data are A_T and
# B_T, 15 and 16 the size and its error. The report's data were never published: take
#   beamfit solve formulations/appendix_a.bf --data d=formulations/fitdata_simulated.csv
minimize obj;
variable s11 in [0, 10] random [0, 10] seed 11;
variable s12 in [0, 10] random [0, 10] seed 12;
variable s22 in [0, 10] random [0, 10] seed 21;
solver "com.pav.pdas.optimization.snopt.SnoptDirect" {
  "major feasibility tolerance" = 1e-6;
  "major optimality tolerance" = 1e-6;
  "major print level" = 1;
  "print file" = 6;
  solution = true;
  "solution file" = 6;
}

table d = "fitdata.csv" [14, 23];
input s11, s12, s22;
output obj, dx_model[K];
set K = |1:14|;
set J = |1:23|;
real data[K, J] = d, A[K], B[K], dx_measured[K], sdx_measured[K], dx2_model[K], error_linear[K],
  error_linear_ns[K], error_nonlinear[K], error_nonlinear_ns[K], s11_s, s12_s, s22_s;
A[k] = data[k, 9] foreach k in K;
B[k] = data[k, 10] foreach k in K;
dx_measured[k] = data[k, 15] foreach k in K;
sdx_measured[k] = data[k, 16] foreach k in K;
s11_s = s11/1e8;
s12_s = s12/1e8;
s22_s = s22/1e8;
dx2_model[k] = A[k]^2*s11_s + 2*A[k]*B[k]*s12_s + B[k]^2*s22_s foreach k in K;
dx_model[k] = 1e6*sqrt(dx2_model[k]) foreach k in K;
foreach k in K {
  error_linear[k] = (dx_model[k]^2 - dx_measured[k]^2)/(2*dx_measured[k]*sdx_measured[k]);
  error_linear_ns[k] = dx_model[k]^2 - dx_measured[k]^2;
  error_nonlinear[k] = (dx_model[k] - dx_measured[k])/sdx_measured[k];
  error_nonlinear_ns[k] = dx_model[k] - dx_measured[k];
}
obj = sum(k in K | error_linear[k]^2);
