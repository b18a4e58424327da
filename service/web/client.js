import{a,b}from"./chunk-ECQAF2VS.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
