import{a,b}from"./chunk-YLBQ3YSA.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
