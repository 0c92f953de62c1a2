//! Algorithm 1 against the oracle vectors, fixed and floating base.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod oracle;

use oracle::{assert_close, flat, unconstrained};

#[test]
fn residual_and_next_momentum_match_the_vectors() {
    let mut count = 0;
    for case in unconstrained() {
        let del = case.evaluated();
        let mut residual = vec![0.0; case.s * case.tree.dof()];
        del.residual_into(&case.tree, &mut residual);
        let eval = &case.json["eval"];
        assert_close(&format!("{} residual", case.name), &residual, &case.rows(&eval["residual"]), 1e-12);
        let mut p = vec![0.0; case.tree.dof()];
        del.next_momentum_into(&case.tree, &mut p);
        let want = if case.tree.is_floating() {
            let mut want = flat(&eval["P1"]);
            want.extend(flat(&eval["pj1"]));
            want
        } else {
            flat(&eval["p1"])
        };
        assert_close(&format!("{} next momentum", case.name), &p, &want, 1e-12);
        count += 1;
    }
    assert!(count >= 20, "only {count} cases found");
}
